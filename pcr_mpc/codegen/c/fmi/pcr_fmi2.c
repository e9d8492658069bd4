/* FMI 2.0 for co-simulation. */
#include <stdlib.h>
#include <string.h>

#include "fmi2Functions.h"
#include "pcr_fmu.h"

/* The text as the format itself, as some importers do not look at what is to be filled in. */
static void tell(const fmu *instance, fmu_status status, const char *category, const char *text)
{
    char format[2048];
    size_t at = 0;
    for (; *text != '\0' && at + 2 < sizeof format; text++) {
        format[at++] = *text;
        if (*text == '%') {
            format[at++] = '%';
        }
    }
    format[at] = '\0';
    ((fmi2CallbackLogger)instance->callback)(instance->environment, instance->name, (fmi2Status)status, category,
                                             format);
}

static fmi2Status unknown(fmi2Component c, const char *what)
{
    return (fmi2Status)fmu_say(c, FMU_ERROR, "this model has no %s", what);
}

const char *fmi2GetTypesPlatform(void)
{
    return fmi2TypesPlatform;
}

const char *fmi2GetVersion(void)
{
    return fmi2Version;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String token, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging)
{
    (void)resources, (void)visible, (void)logging; /* what is told is worth telling always */
    if (functions == NULL || type != fmi2CoSimulation) {
        return NULL;
    }
    return fmu_new(name, token, tell, functions->componentEnvironment, (void (*)(void))functions->logger);
}

void fmi2FreeInstance(fmi2Component c)
{
    free(c);
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean logging, size_t count, const fmi2String categories[])
{
    (void)c, (void)logging, (void)count, (void)categories;
    return fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean tolerant, fmi2Real tolerance, fmi2Real start,
                               fmi2Boolean stops, fmi2Real stop)
{
    (void)tolerant, (void)tolerance, (void)stops, (void)stop;
    return (fmi2Status)fmu_set_start(c, start);
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    return (fmi2Status)fmu_enter(c);
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    return (fmi2Status)fmu_exit(c);
}

fmi2Status fmi2Terminate(fmi2Component c)
{
    return (fmi2Status)fmu_terminate(c);
}

fmi2Status fmi2Reset(fmi2Component c)
{
    fmu_reset(c);
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference at[], size_t count, fmi2Real values[])
{
    return (fmi2Status)fmu_get_reals(c, at, count, values);
}

fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference at[], size_t count, fmi2Integer values[])
{
    return (fmi2Status)fmu_get_wholes(c, at, count, values);
}

fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference at[], size_t count, fmi2Boolean values[])
{
    (void)at, (void)values;
    return (fmi2Status)fmu_none(c, count, "Boolean");
}

fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference at[], size_t count, fmi2String values[])
{
    (void)at, (void)values;
    return (fmi2Status)fmu_none(c, count, "String");
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference at[], size_t count, const fmi2Real values[])
{
    return (fmi2Status)fmu_set_reals(c, at, count, values);
}

fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference at[], size_t count, const fmi2Integer values[])
{
    (void)at, (void)values;
    return count == 0 ? fmi2OK : unknown(c, "whole number that could be set");
}

fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference at[], size_t count, const fmi2Boolean values[])
{
    (void)at, (void)values;
    return (fmi2Status)fmu_none(c, count, "Boolean");
}

fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference at[], size_t count, const fmi2String values[])
{
    (void)at, (void)values;
    return (fmi2Status)fmu_none(c, count, "String");
}

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    return (fmi2Status)fmu_get_state(c, state);
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state)
{
    return (fmi2Status)fmu_set_state(c, state);
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    (void)c;
    if (state != NULL) {
        free(*state);
        *state = NULL;
    }
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size)
{
    (void)c, (void)state;
    *size = sizeof(fmu_state);
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size)
{
    if (state == NULL || size < sizeof(fmu_state)) {
        return (fmi2Status)fmu_say(c, FMU_ERROR, "there is no state, or no room for its %lu bytes in %lu",
                                   (unsigned long)sizeof(fmu_state), (unsigned long)size);
    }
    memcpy(bytes, state, sizeof(fmu_state));
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state)
{
    return (fmi2Status)fmu_read_state(c, bytes, size, state);
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference of[], size_t n,
                                        const fmi2ValueReference by[], size_t m, const fmi2Real seed[],
                                        fmi2Real sensitivity[])
{
    (void)of, (void)n, (void)by, (void)m, (void)seed, (void)sensitivity;
    return unknown(c, "directional derivatives");
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference at[], size_t count,
                                       const fmi2Integer order[], const fmi2Real values[])
{
    (void)at, (void)order, (void)values;
    return count == 0 ? fmi2OK : unknown(c, "use for derivatives of inputs: they are held over a step");
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference at[], size_t count,
                                        const fmi2Integer order[], fmi2Real values[])
{
    (void)at, (void)order, (void)values;
    return count == 0 ? fmi2OK : unknown(c, "derivatives of outputs");
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real step, fmi2Boolean no_way_back)
{
    (void)no_way_back;
    return (fmi2Status)fmu_step(c, time, step);
}

fmi2Status fmi2CancelStep(fmi2Component c)
{
    return unknown(c, "step that could be cancelled: none is pending");
}

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value)
{
    (void)c, (void)kind, (void)value;
    return fmi2Discard; /* no step is ever pending */
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value)
{
    if (kind != fmi2LastSuccessfulTime) {
        return fmi2Discard;
    }
    *value = ((const fmu *)c)->state.time;
    return fmi2OK;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Integer *value)
{
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value)
{
    (void)c;
    if (kind != fmi2Terminated) {
        return fmi2Discard;
    }
    *value = fmi2False; /* whoever has discarded a step may go on with other inputs */
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind kind, fmi2String *value)
{
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}
