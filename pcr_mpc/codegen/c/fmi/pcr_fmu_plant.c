/* The plant as a model of FMI: motor rates and a force on the tip go in, its motion comes out. */
#include <math.h>
#include <stdio.h>
#include <string.h>

#include "pcr_fmu.h"

static void show(fmu *instance)
{
    fmu_state *state = &instance->state;
    memcpy(state->reals + FMU_X, state->part.x, sizeof state->part.x);
    pcr_plant_angles(&state->part, state->reals + FMU_X + 4);
    state->wholes[FMU_CORRECTIONS] = state->part.corrections;
}

static fmu_status number(fmu *instance)
{
    const double *numbers = instance->state.reals + FMU_NUMBERS;
    const int at = pcr_plant_refused_number(numbers);
    if (at >= 0) {
        return fmu_say(instance, FMU_ERROR, "at %.9g s: %s = %g is refused: no robot can have it beside the others",
                       instance->state.time, pcr_fmu_tunables[at], numbers[at]);
    }
    switch (pcr_plant_set_numbers(&instance->state.part, numbers)) {
    case PCR_OK:
        return FMU_OK;
    case PCR_OUT_OF_REACH:
        return fmu_say(instance, FMU_ERROR, "at %.9g s: rods with these numbers cannot be where the robot is",
                       instance->state.time);
    default:
        return fmu_say(instance, FMU_ERROR, "this plant cannot have other numbers");
    }
}

fmu_status fmu_part_start(fmu *instance)
{
    fmu_state *state = &instance->state;
    const double *at = state->reals + FMU_START;
    const size_t numbers = FMU_TUNABLE_END - FMU_NUMBERS;
    pcr_pose pose;
    memcpy(pose.p, at, sizeof pose.p);
    memcpy(pose.q, at + 2, sizeof pose.q);
    const int elsewhere = memcmp(at, pcr_fmu_starts + FMU_START, (2 + PCR_N) * sizeof *at) != 0;
    if (pcr_plant_init(&state->part, elsewhere ? &pose : NULL) != PCR_OK) {
        return fmu_say(instance, FMU_ERROR, "the rods cannot follow from the scene's start to p = (%g, %g) m with these "
                       "motor angles, or the plant has rods with mass and can start there only", pose.p[0], pose.p[1]);
    }
    if (numbers && memcmp(state->reals + FMU_NUMBERS, pcr_fmu_starts + FMU_NUMBERS, numbers * sizeof *at) != 0) {
        const fmu_status found = number(instance);
        if (found != FMU_OK) {
            return found;
        }
    }
    show(instance);
    return FMU_OK;
}

fmu_status fmu_part_tune(fmu *instance)
{
    return number(instance);
}

/* Where a plant is that cannot go on. */
static fmu_status lost(fmu *instance, const double *u)
{
    const double *x = instance->state.part.x;
    char angles[PCR_N * 40 + 1] = "";
    for (int i = 0, at = 0; i < PCR_N; i++) {
        at += snprintf(angles + at, sizeof angles - (size_t)at, " %.6g (%.4g)", x[4 + i], u[i]);
    }
    return fmu_say(instance, FMU_DISCARD, "at %.9g s: the rods cannot follow, a snap is near: p = (%.6g, %.6g) m, "
                   "v = (%.4g, %.4g) m/s, motor angles [rad] (and rates [rad/s])%s; the plant is left there",
                   instance->state.time, x[0], x[1], x[2], x[3], angles);
}

fmu_status fmu_part_step(fmu *instance, double step)
{
    fmu_state *state = &instance->state;
    pcr_plant *plant = &state->part;
    const double *u = state->reals + FMU_U, *force = state->reals + FMU_FORCE;
    const double count = rint(step / PCR_PLANT_STEP), began = state->time;
    fmu_status found = FMU_OK;
    if (!(count >= 1.0 && fabs(step - count * PCR_PLANT_STEP) <= 1e-6 * PCR_PLANT_STEP)) {
        return fmu_say(instance, FMU_DISCARD, "at %.9g s: a step of %.9g s is no whole number of the plant's steps of "
                       "%.9g s", began, step, PCR_PLANT_STEP);
    }
    for (int i = 0; i < FMU_INPUTS_END; i++) {
        if (!isfinite(state->reals[i])) {
            return fmu_say(instance, FMU_ERROR, "at %.9g s: the input %s is %g", began, pcr_fmu_inputs[i],
                           state->reals[i]);
        }
    }
#ifdef FMU_PAYLOAD
    if (state->reals[FMU_PAYLOAD] != plant->payload && pcr_plant_carry(plant, state->reals[FMU_PAYLOAD]) != PCR_OK) {
        return fmu_say(instance, FMU_ERROR, "at %.9g s: the tip cannot carry a payload of %g kg", began,
                       state->reals[FMU_PAYLOAD]);
    }
#endif
    for (double done = 1.0; done <= count; done += 1.0) {
        if (pcr_plant_step(plant, u, force) != PCR_OK) {
            found = lost(instance, u);
            break;
        }
        state->time = done < count ? began + done * PCR_PLANT_STEP : began + step;
    }
    show(instance);
    return found;
}

void fmu_part_restore(fmu_part *part, const fmu_part *saved)
{
    memcpy(part, saved, sizeof *part);
}
