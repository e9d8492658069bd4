/* FMI 3.0 for co-simulation. What belongs to other kinds of models is there, as importers ask for it, and says no. */
#include <stdlib.h>
#include <string.h>

#include "fmi3Functions.h"
#include "pcr_fmu.h"

static void tell(const fmu *instance, fmu_status status, const char *category, const char *text)
{
    ((fmi3LogMessageCallback)instance->callback)(instance->environment, (fmi3Status)status, category, text);
}

static fmi3Status unknown(fmi3Instance c, const char *what)
{
    return (fmi3Status)fmu_say(c, FMU_ERROR, "this model has no %s", what);
}

const char *fmi3GetVersion(void)
{
    return fmi3Version;
}

fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean logging, size_t count, const fmi3String categories[])
{
    (void)c, (void)logging, (void)count, (void)categories;
    return fmi3OK;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                          fmi3Boolean logging, fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment, (void)log;
    return NULL;
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early,
                                         const fmi3ValueReference between[], size_t count,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback update)
{
    (void)resources, (void)visible, (void)logging, (void)early, (void)between, (void)count, (void)update;
    return events ? NULL : fmu_new(name, token, tell, environment, (void (*)(void))log);
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources,
                                               fmi3Boolean visible, fmi3Boolean logging,
                                               fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                               fmi3ClockUpdateCallback clock, fmi3LockPreemptionCallback lock,
                                               fmi3UnlockPreemptionCallback unlock)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment, (void)log;
    (void)clock, (void)lock, (void)unlock;
    return NULL;
}

void fmi3FreeInstance(fmi3Instance c)
{
    free(c);
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean tolerant, fmi3Float64 tolerance, fmi3Float64 start,
                                       fmi3Boolean stops, fmi3Float64 stop)
{
    (void)tolerant, (void)tolerance, (void)stops, (void)stop;
    const fmu_status found = fmu_set_start(c, start);
    return (fmi3Status)(found == FMU_OK ? fmu_enter(c) : found);
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance c)
{
    return (fmi3Status)fmu_exit(c);
}

fmi3Status fmi3EnterEventMode(fmi3Instance c)
{
    return unknown(c, "event mode");
}

fmi3Status fmi3Terminate(fmi3Instance c)
{
    return (fmi3Status)fmu_terminate(c);
}

fmi3Status fmi3Reset(fmi3Instance c)
{
    fmu_reset(c);
    return fmi3OK;
}

fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference at[], size_t count, fmi3Float64 values[], size_t n)
{
    return n == count ? (fmi3Status)fmu_get_reals(c, at, count, values) : unknown(c, "arrays");
}

fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference at[], size_t count, const fmi3Float64 values[],
                          size_t n)
{
    return n == count ? (fmi3Status)fmu_set_reals(c, at, count, values) : unknown(c, "arrays");
}

fmi3Status fmi3GetInt32(fmi3Instance c, const fmi3ValueReference at[], size_t count, fmi3Int32 values[], size_t n)
{
    return n == count ? (fmi3Status)fmu_get_wholes(c, at, count, values) : unknown(c, "arrays");
}

fmi3Status fmi3SetInt32(fmi3Instance c, const fmi3ValueReference at[], size_t count, const fmi3Int32 values[], size_t n)
{
    (void)at, (void)values, (void)n;
    return count == 0 ? fmi3OK : unknown(c, "whole number that could be set");
}

#define NONE(kind)                                                                                                     \
    fmi3Status fmi3Get##kind(fmi3Instance c, const fmi3ValueReference at[], size_t count, fmi3##kind values[],         \
                             size_t n)                                                                                 \
    {                                                                                                                  \
        (void)at, (void)values, (void)n;                                                                               \
        return (fmi3Status)fmu_none(c, count, #kind);                                                                  \
    }                                                                                                                  \
    fmi3Status fmi3Set##kind(fmi3Instance c, const fmi3ValueReference at[], size_t count, const fmi3##kind values[],   \
                             size_t n)                                                                                 \
    {                                                                                                                  \
        (void)at, (void)values, (void)n;                                                                               \
        return (fmi3Status)fmu_none(c, count, #kind);                                                                  \
    }

NONE(Float32)
NONE(Int8)
NONE(UInt8)
NONE(Int16)
NONE(UInt16)
NONE(UInt32)
NONE(Int64)
NONE(UInt64)
NONE(Boolean)
NONE(String)

fmi3Status fmi3GetBinary(fmi3Instance c, const fmi3ValueReference at[], size_t count, size_t sizes[],
                         fmi3Binary values[], size_t n)
{
    (void)at, (void)sizes, (void)values, (void)n;
    return (fmi3Status)fmu_none(c, count, "Binary");
}

fmi3Status fmi3SetBinary(fmi3Instance c, const fmi3ValueReference at[], size_t count, const size_t sizes[],
                         const fmi3Binary values[], size_t n)
{
    (void)at, (void)sizes, (void)values, (void)n;
    return (fmi3Status)fmu_none(c, count, "Binary");
}

fmi3Status fmi3GetClock(fmi3Instance c, const fmi3ValueReference at[], size_t count, fmi3Clock values[])
{
    (void)at, (void)values;
    return (fmi3Status)fmu_none(c, count, "Clock");
}

fmi3Status fmi3SetClock(fmi3Instance c, const fmi3ValueReference at[], size_t count, const fmi3Clock values[])
{
    (void)at, (void)values;
    return (fmi3Status)fmu_none(c, count, "Clock");
}

fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance c, fmi3ValueReference at, size_t *count)
{
    (void)at, (void)count;
    return unknown(c, "list of dependencies: all depends on all");
}

fmi3Status fmi3GetVariableDependencies(fmi3Instance c, fmi3ValueReference of, size_t at[], fmi3ValueReference by[],
                                       size_t at_by[], fmi3DependencyKind kinds[], size_t count)
{
    (void)of, (void)at, (void)by, (void)at_by, (void)kinds, (void)count;
    return unknown(c, "list of dependencies: all depends on all");
}

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state)
{
    return (fmi3Status)fmu_get_state(c, state);
}

fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state)
{
    return (fmi3Status)fmu_set_state(c, state);
}

fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *state)
{
    (void)c;
    if (state != NULL) {
        free(*state);
        *state = NULL;
    }
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState state, size_t *size)
{
    (void)c, (void)state;
    *size = sizeof(fmu_state);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState state, fmi3Byte bytes[], size_t size)
{
    if (state == NULL || size < sizeof(fmu_state)) {
        return (fmi3Status)fmu_say(c, FMU_ERROR, "there is no state, or no room for its %lu bytes in %lu",
                                   (unsigned long)sizeof(fmu_state), (unsigned long)size);
    }
    memcpy(bytes, state, sizeof(fmu_state));
    return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size, fmi3FMUState *state)
{
    return (fmi3Status)fmu_read_state(c, bytes, size, state);
}

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, const fmi3ValueReference of[], size_t n,
                                        const fmi3ValueReference by[], size_t m, const fmi3Float64 seed[], size_t seeds,
                                        fmi3Float64 sensitivity[], size_t count)
{
    (void)of, (void)n, (void)by, (void)m, (void)seed, (void)seeds, (void)sensitivity, (void)count;
    return unknown(c, "directional derivatives");
}

fmi3Status fmi3GetAdjointDerivative(fmi3Instance c, const fmi3ValueReference of[], size_t n,
                                    const fmi3ValueReference by[], size_t m, const fmi3Float64 seed[], size_t seeds,
                                    fmi3Float64 sensitivity[], size_t count)
{
    (void)of, (void)n, (void)by, (void)m, (void)seed, (void)seeds, (void)sensitivity, (void)count;
    return unknown(c, "adjoint derivatives");
}

fmi3Status fmi3EnterConfigurationMode(fmi3Instance c)
{
    return unknown(c, "configuration mode");
}

fmi3Status fmi3ExitConfigurationMode(fmi3Instance c)
{
    return unknown(c, "configuration mode");
}

fmi3Status fmi3GetIntervalDecimal(fmi3Instance c, const fmi3ValueReference at[], size_t count, fmi3Float64 intervals[],
                                  fmi3IntervalQualifier kinds[])
{
    (void)at, (void)intervals, (void)kinds;
    return (fmi3Status)fmu_none(c, count, "Clock");
}

fmi3Status fmi3GetIntervalFraction(fmi3Instance c, const fmi3ValueReference at[], size_t count, fmi3UInt64 counters[],
                                   fmi3UInt64 resolutions[], fmi3IntervalQualifier kinds[])
{
    (void)at, (void)counters, (void)resolutions, (void)kinds;
    return (fmi3Status)fmu_none(c, count, "Clock");
}

fmi3Status fmi3GetShiftDecimal(fmi3Instance c, const fmi3ValueReference at[], size_t count, fmi3Float64 shifts[])
{
    (void)at, (void)shifts;
    return (fmi3Status)fmu_none(c, count, "Clock");
}

fmi3Status fmi3GetShiftFraction(fmi3Instance c, const fmi3ValueReference at[], size_t count, fmi3UInt64 counters[],
                                fmi3UInt64 resolutions[])
{
    (void)at, (void)counters, (void)resolutions;
    return (fmi3Status)fmu_none(c, count, "Clock");
}

fmi3Status fmi3SetIntervalDecimal(fmi3Instance c, const fmi3ValueReference at[], size_t count,
                                  const fmi3Float64 intervals[])
{
    (void)at, (void)intervals;
    return (fmi3Status)fmu_none(c, count, "Clock");
}

fmi3Status fmi3SetIntervalFraction(fmi3Instance c, const fmi3ValueReference at[], size_t count,
                                   const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])
{
    (void)at, (void)counters, (void)resolutions;
    return (fmi3Status)fmu_none(c, count, "Clock");
}

fmi3Status fmi3SetShiftDecimal(fmi3Instance c, const fmi3ValueReference at[], size_t count, const fmi3Float64 shifts[])
{
    (void)at, (void)shifts;
    return (fmi3Status)fmu_none(c, count, "Clock");
}

fmi3Status fmi3SetShiftFraction(fmi3Instance c, const fmi3ValueReference at[], size_t count,
                                const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])
{
    (void)at, (void)counters, (void)resolutions;
    return (fmi3Status)fmu_none(c, count, "Clock");
}

fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance c)
{
    return unknown(c, "events");
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *again, fmi3Boolean *ends, fmi3Boolean *nominals,
                                    fmi3Boolean *values, fmi3Boolean *timed, fmi3Float64 *next)
{
    (void)again, (void)ends, (void)nominals, (void)values, (void)timed, (void)next;
    return unknown(c, "events");
}

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c)
{
    return unknown(c, "model exchange");
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean no_way_back, fmi3Boolean *event, fmi3Boolean *ends)
{
    (void)no_way_back, (void)event, (void)ends;
    return unknown(c, "model exchange");
}

fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 time)
{
    (void)time;
    return unknown(c, "model exchange");
}

fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 x[], size_t count)
{
    (void)x, (void)count;
    return unknown(c, "model exchange");
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 derivatives[], size_t count)
{
    (void)derivatives, (void)count;
    return unknown(c, "model exchange");
}

fmi3Status fmi3GetEventIndicators(fmi3Instance c, fmi3Float64 indicators[], size_t count)
{
    (void)indicators, (void)count;
    return unknown(c, "model exchange");
}

fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t count)
{
    (void)x, (void)count;
    return unknown(c, "model exchange");
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 nominals[], size_t count)
{
    (void)nominals, (void)count;
    return unknown(c, "model exchange");
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *count)
{
    (void)count;
    return unknown(c, "model exchange");
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *count)
{
    (void)count;
    return unknown(c, "model exchange");
}

fmi3Status fmi3EnterStepMode(fmi3Instance c)
{
    return unknown(c, "event mode");
}

fmi3Status fmi3GetOutputDerivatives(fmi3Instance c, const fmi3ValueReference at[], size_t count,
                                    const fmi3Int32 orders[], fmi3Float64 values[], size_t n)
{
    (void)at, (void)orders, (void)values, (void)n;
    return count == 0 ? fmi3OK : unknown(c, "derivatives of outputs");
}

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 time, fmi3Float64 step, fmi3Boolean no_way_back, fmi3Boolean *event,
                      fmi3Boolean *ends, fmi3Boolean *early, fmi3Float64 *reached)
{
    (void)no_way_back;
    const fmu_status found = fmu_step(c, time, step);
    *event = *ends = *early = fmi3False;
    *reached = ((const fmu *)c)->state.time;
    return (fmi3Status)found;
}

fmi3Status fmi3ActivateModelPartition(fmi3Instance c, fmi3ValueReference clock, fmi3Float64 time)
{
    (void)clock, (void)time;
    return unknown(c, "scheduled execution");
}
