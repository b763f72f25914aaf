/* all.c for Windows without a C runtime of its own: what it needs is imported from ucrtbase.dll, which is part of the
 * system. `vsnprintf` is no function there but made of another one. */
#define _UCRT
#include "all.c"

int __cdecl vsnprintf(char *text, size_t size, const char *format, va_list arguments)
{
    enum { AS_IN_C99 = 2 };
    return __stdio_common_vsprintf(AS_IN_C99, text, size, format, NULL, arguments);
}

/* Nothing is to be done when the library is loaded. */
int __stdcall DllMainCRTStartup(void *instance, unsigned long reason, void *reserved)
{
    (void)instance, (void)reason, (void)reserved;
    return 1;
}
