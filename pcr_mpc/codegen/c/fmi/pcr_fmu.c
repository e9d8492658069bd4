/* An instance of the model: its values, its phases, its states. */
#include "pcr_fmu.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

fmu_status fmu_say(const fmu *instance, fmu_status status, const char *format, ...)
{
    static const char *const categories[] = {"logEvents", "logStatusWarning", "logStatusDiscard", "logStatusError"};
    char text[1024];
    va_list words;
    va_start(words, format);
    vsnprintf(text, sizeof text, format, words);
    va_end(words);
    if (instance->log != NULL) {
        instance->log(instance, status, categories[status], text);
    }
    return status;
}

fmu *fmu_new(const char *name, const char *token, fmu_logger *log, void *environment, void (*callback)(void))
{
    const char *called = name == NULL ? "" : name;
    fmu *instance = calloc(1, sizeof *instance + strlen(called) + 1);
    if (instance == NULL) {
        return NULL;
    }
    strcpy(instance->name, called);
    instance->log = callback == NULL ? NULL : log;
    instance->environment = environment;
    instance->callback = callback;
    if (token == NULL || strcmp(token, FMU_TOKEN) != 0) {
        fmu_say(instance, FMU_ERROR, "the token %s is that of another model, not %s: modelDescription.xml and binary "
                "do not belong together", token == NULL ? "(none)" : token, FMU_TOKEN);
        free(instance);
        return NULL;
    }
    fmu_reset(instance);
    return instance;
}

void fmu_reset(fmu *instance)
{
    fmu_state *state = &instance->state;
    memset(state, 0, sizeof *state);
    strcpy(state->token, FMU_TOKEN);
    memcpy(state->reals, pcr_fmu_starts, sizeof pcr_fmu_starts);
}

fmu_status fmu_set_start(fmu *instance, double start)
{
    if (instance->state.phase != FMU_INSTANTIATED || !isfinite(start)) {
        return fmu_say(instance, FMU_ERROR, "a run cannot start at %g s, or has begun already", start);
    }
    instance->state.start = instance->state.time = start;
    return FMU_OK;
}

fmu_status fmu_enter(fmu *instance)
{
    if (instance->state.phase != FMU_INSTANTIATED) {
        return fmu_say(instance, FMU_ERROR, "initialization was begun already: reset the instance first");
    }
    instance->state.phase = FMU_INITIALISING;
    return FMU_OK;
}

/* Let the part start if it has not yet with the values as they are. */
static fmu_status start(fmu *instance)
{
    fmu_state *state = &instance->state;
    if (state->phase > FMU_INITIALISING || state->started) {
        return FMU_OK;
    }
    const fmu_status found = fmu_part_start(instance);
    state->started = found == FMU_OK;
    return found;
}

fmu_status fmu_exit(fmu *instance)
{
    if (instance->state.phase != FMU_INITIALISING) {
        return fmu_say(instance, FMU_ERROR, "initialization cannot be ended: it was not begun");
    }
    const fmu_status found = start(instance);
    instance->state.phase = found == FMU_OK ? FMU_STEPPING : FMU_FAILED;
    return found;
}

fmu_status fmu_terminate(fmu *instance)
{
    if (instance->state.phase != FMU_STEPPING && instance->state.phase != FMU_FAILED) {
        return fmu_say(instance, FMU_ERROR, "there is no run to be terminated");
    }
    instance->state.phase = FMU_TERMINATED;
    return FMU_OK;
}

fmu_status fmu_step(fmu *instance, double time, double step)
{
    fmu_state *state = &instance->state;
    if (state->phase != FMU_STEPPING) {
        return fmu_say(instance, FMU_ERROR, "no step is possible: %s", state->phase == FMU_FAILED
                       ? "the run has failed, reset the instance" : "initialization is not complete, or the run is over");
    }
    if (!(step > 0.0 && isfinite(step) && isfinite(time))) {
        return fmu_say(instance, FMU_ERROR, "a step of %g s at %g s is none: it must be positive", step, time);
    }
    if (!(fabs(time - state->time) <= FMU_NEAR * FMU_STEP)) {
        return fmu_say(instance, FMU_ERROR, "a step is to begin at %.9g s, but the instance is at %.9g s", time,
                       state->time);
    }
    state->time = time;
    fmu_status found = FMU_OK;
    if (state->changed) {
        found = fmu_part_tune(instance);
        state->changed = 0;
    }
    found = found == FMU_OK ? fmu_part_step(instance, step) : found;
    if (found == FMU_ERROR) {
        state->phase = FMU_FAILED;
    }
    return found;
}

fmu_status fmu_get_reals(fmu *instance, const unsigned *at, size_t count, double *values)
{
    const fmu_status found = start(instance);
    for (size_t i = 0; found == FMU_OK && i < count; i++) {
        if (at[i] == FMU_REALS + FMU_WHOLES) {
            values[i] = instance->state.time;
        } else if (at[i] < FMU_REALS) {
            values[i] = instance->state.reals[at[i]];
        } else {
            return fmu_say(instance, FMU_ERROR, "there is no real variable with the value reference %u", at[i]);
        }
    }
    return found;
}

fmu_status fmu_set_reals(fmu *instance, const unsigned *at, size_t count, const double *values)
{
    fmu_state *state = &instance->state;
    const int before = state->phase <= FMU_INITIALISING;
    for (size_t i = 0; i < count; i++) {
        if (at[i] >= FMU_TUNABLE_END) {
            return fmu_say(instance, FMU_ERROR, "the variable with the value reference %u cannot be set", at[i]);
        }
        if (at[i] >= FMU_INPUTS_END && at[i] < FMU_FIXED_END && !before) {
            return fmu_say(instance, FMU_ERROR, "the parameter with the value reference %u is fixed: set it before "
                           "initialization is complete, or reset the instance", at[i]);
        }
    }
    for (size_t i = 0; i < count; i++) {
        state->changed = state->changed || (!before && at[i] >= FMU_FIXED_END && state->reals[at[i]] != values[i]);
        state->started = state->started && !(before && at[i] >= FMU_INPUTS_END);
        state->reals[at[i]] = values[i];
    }
    return FMU_OK;
}

fmu_status fmu_get_wholes(fmu *instance, const unsigned *at, size_t count, int *values)
{
    const fmu_status found = start(instance);
    for (size_t i = 0; found == FMU_OK && i < count; i++) {
        if (at[i] < FMU_REALS || at[i] >= FMU_REALS + FMU_WHOLES) {
            return fmu_say(instance, FMU_ERROR, "there is no whole number with the value reference %u", at[i]);
        }
        values[i] = instance->state.wholes[at[i] - FMU_REALS];
    }
    return found;
}

fmu_status fmu_none(const fmu *instance, size_t count, const char *type)
{
    return count == 0 ? FMU_OK : fmu_say(instance, FMU_ERROR, "there are no variables of type %s to get or set", type);
}

fmu_status fmu_get_state(const fmu *instance, void **state)
{
    if (*state == NULL) {
        *state = malloc(sizeof instance->state);
    }
    if (*state == NULL) {
        return fmu_say(instance, FMU_ERROR, "no memory for a state of %lu bytes", (unsigned long)sizeof(fmu_state));
    }
    memcpy(*state, &instance->state, sizeof instance->state);
    return FMU_OK;
}

fmu_status fmu_set_state(fmu *instance, const void *state)
{
    const fmu_state *saved = state;
    if (saved == NULL) {
        return fmu_say(instance, FMU_ERROR, "there is no state to be set");
    }
    memcpy(&instance->state, saved, offsetof(fmu_state, part));
    if (saved->started) {
        fmu_part_restore(&instance->state.part, &saved->part);
    }
    return FMU_OK;
}

fmu_status fmu_read_state(const fmu *instance, const void *bytes, size_t size, void **state)
{
    if (size != sizeof(fmu_state) || memcmp(bytes, FMU_TOKEN, sizeof FMU_TOKEN) != 0) {
        return fmu_say(instance, FMU_ERROR, "these %lu bytes are no state of this model, which has %lu",
                       (unsigned long)size, (unsigned long)sizeof(fmu_state));
    }
    *state = malloc(size);
    if (*state == NULL) {
        return fmu_say(instance, FMU_ERROR, "no memory for a state of %lu bytes", (unsigned long)size);
    }
    memcpy(*state, bytes, size);
    return FMU_OK;
}
