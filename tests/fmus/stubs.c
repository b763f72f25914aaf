/* Every function that FMPy wants to find in a binary, each an error unless another file defines it. */

#define WEAK(name) __attribute__((weak, visibility("default"))) int name(void) { return 3; }

#if FMI == 2
#define F(name) WEAK(fmi2##name)
F(GetTypesPlatform) F(GetVersion) F(SetDebugLogging) F(Instantiate) F(FreeInstance) F(SetupExperiment)
F(EnterInitializationMode) F(ExitInitializationMode) F(Terminate) F(Reset) F(GetReal) F(GetInteger) F(GetBoolean)
F(GetString) F(SetReal) F(SetInteger) F(SetBoolean) F(SetString) F(GetFMUstate) F(SetFMUstate) F(FreeFMUstate)
F(SerializedFMUstateSize) F(SerializeFMUstate) F(DeSerializeFMUstate) F(GetDirectionalDerivative) F(EnterEventMode)
F(NewDiscreteStates) F(EnterContinuousTimeMode) F(CompletedIntegratorStep) F(SetTime) F(SetContinuousStates)
F(GetDerivatives) F(GetEventIndicators) F(GetContinuousStates) F(GetNominalsOfContinuousStates)
F(SetRealInputDerivatives) F(GetRealOutputDerivatives) F(DoStep) F(CancelStep) F(GetStatus) F(GetRealStatus)
F(GetIntegerStatus) F(GetBooleanStatus) F(GetStringStatus)
#elif FMI == 3
#define F(name) WEAK(fmi3##name)
#define GS(name) F(Get##name) F(Set##name)
F(GetVersion) F(SetDebugLogging) F(InstantiateModelExchange) F(InstantiateCoSimulation)
F(InstantiateScheduledExecution) F(FreeInstance) F(EnterInitializationMode) F(ExitInitializationMode)
F(EnterEventMode) F(Terminate) F(Reset) GS(Float32) GS(Float64) GS(Int8) GS(UInt8) GS(Int16) GS(UInt16) GS(Int32)
GS(UInt32) GS(Int64) GS(UInt64) GS(Boolean) GS(String) GS(Binary) GS(Clock) F(GetNumberOfVariableDependencies)
F(GetVariableDependencies) GS(FMUState) F(FreeFMUState) F(SerializedFMUStateSize) F(SerializeFMUState)
F(DeserializeFMUState) F(GetDirectionalDerivative) F(GetAdjointDerivative) F(EnterConfigurationMode)
F(ExitConfigurationMode) GS(IntervalDecimal) GS(IntervalFraction) GS(ShiftDecimal) GS(ShiftFraction)
F(EvaluateDiscreteStates) F(UpdateDiscreteStates) F(EnterContinuousTimeMode) F(CompletedIntegratorStep) F(SetTime)
F(SetContinuousStates) F(GetContinuousStateDerivatives) F(GetEventIndicators) F(GetContinuousStates)
F(GetNominalsOfContinuousStates) F(GetNumberOfEventIndicators) F(GetNumberOfContinuousStates) F(EnterStepMode)
F(GetOutputDerivatives) F(DoStep) F(ActivateModelPartition)
#endif
