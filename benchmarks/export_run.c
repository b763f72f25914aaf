/* Loads the binary of an FMI 2.0 FMU and prints the bits of some values after some steps, for `export.py`: on Linux and,
 * without a C runtime, on Windows, so that the binaries of other platforms can be run under an emulator.
 *
 *     export_run LIBRARY GUID        values 0 to 2 (states) after 500 steps of 1 ms with value 3 (an input) at 5
 */
#ifdef _WIN32
#define NULL ((void *)0)
__declspec(dllimport) void *__stdcall LoadLibraryA(const char *);
__declspec(dllimport) void *__stdcall GetProcAddress(void *, const char *);
__declspec(dllimport) void *__stdcall GetStdHandle(unsigned);
__declspec(dllimport) int __stdcall WriteFile(void *, const void *, unsigned, unsigned *, void *);
__declspec(dllimport) void __stdcall ExitProcess(unsigned);
__declspec(dllimport) char *__stdcall GetCommandLineA(void);
#define OPEN(path) LoadLibraryA(path)
#define FIND(library, name) GetProcAddress(library, name)
static void print(const char *text, unsigned length)
{
    unsigned done;
    WriteFile(GetStdHandle((unsigned)-11), text, length, &done, NULL);
}
#else
#include <dlfcn.h>
#include <stdio.h>
#define OPEN(path) dlopen(path, RTLD_NOW)
#define FIND(library, name) dlsym(library, name)
static void print(const char *text, unsigned length)
{
    fwrite(text, 1, length, stdout);
}
#endif

static int run(const char *path, const char *guid)
{
    void *library = OPEN(path);
    if (!library) {
        return 2;
    }
    void *(*make)(const char *, int, const char *, const char *, const void *, int, int) = FIND(library, "fmi2Instantiate");
    int (*setup)(void *, int, double, double, int, double) = FIND(library, "fmi2SetupExperiment");
    int (*enter)(void *) = FIND(library, "fmi2EnterInitializationMode");
    int (*leave)(void *) = FIND(library, "fmi2ExitInitializationMode");
    int (*set)(void *, const unsigned *, unsigned long long, const double *) = FIND(library, "fmi2SetReal");
    int (*get)(void *, const unsigned *, unsigned long long, double *) = FIND(library, "fmi2GetReal");
    int (*step)(void *, double, double, int) = FIND(library, "fmi2DoStep");
    static const void *callbacks[5];
    static const unsigned references[4] = {0, 1, 2, 3};
    const double five = 5.0;
    double x[3];
    void *c = make("run", 1, guid, NULL, callbacks, 0, 0);
    if (!c || setup(c, 0, 0.0, 0.0, 0, 0.0) || enter(c) || set(c, references + 3, 1, &five) || leave(c)) {
        return 3;
    }
    for (int k = 0; k < 500; k++) {
        if (step(c, k * 1e-3, 1e-3, 1)) {
            return 4;
        }
    }
    get(c, references, 3, x);
    for (int i = 0; i < 3; i++) {
        union {
            double number;
            unsigned long long bits;
        } u = {x[i]};
        char text[17];
        for (int k = 0; k < 16; k++) {
            text[k] = "0123456789abcdef"[u.bits >> (60 - 4 * k) & 15];
        }
        text[16] = '\n';
        print(text, 17);
    }
    return 0;
}

#ifdef _WIN32
int _fltused = 0;

void wWinMainCRTStartup(void) /* where the linker begins */
{
    char *line = GetCommandLineA(), *words[3];
    for (int k = 0; k < 3; k++) { /* no word holds a blank */
        while (*line == ' ' || *line == '"') {
            line++;
        }
        words[k] = line;
        while (*line && *line != ' ' && *line != '"') {
            line++;
        }
        if (*line) {
            *line++ = 0;
        }
    }
    ExitProcess(run(words[1], words[2]));
}
#else
int main(int count, char **words)
{
    return count > 2 ? run(words[1], words[2]) : 1;
}
#endif
