/* The controller as a model of FMI: a measurement goes in, motor rates come out.

   It decides at the beginning of a step at which a control period begins, from the inputs as they are then; the rates
   are for the time from there on. A step may be a period or a part of one. */
#include <math.h>
#include <string.h>

#include "pcr_fmu.h"

#define PARAMETERS ((int)(sizeof(pcr_parameters) / sizeof(double)))

static void show(fmu *instance, const pcr_output *output)
{
    fmu_state *state = &instance->state;
    double *reals = state->reals;
    int *wholes = state->wholes;
    memcpy(reals + FMU_U, output->u, sizeof output->u);
    reals[FMU_RESIDUALS] = output->primal_residual;
    reals[FMU_RESIDUALS + 1] = output->dual_residual;
    memcpy(reals + FMU_ESTIMATE, output->estimate, sizeof output->estimate);
    memcpy(reals + FMU_OBSERVED, output->force, sizeof output->force);
    reals[FMU_STIFFNESS] = output->stiffness;
    memcpy(reals + FMU_TORQUE, output->torque, sizeof output->torque);
    memcpy(reals + FMU_SLACK, output->slack + 2, 6 * sizeof *output->slack); /* motors' rates never give way */
    wholes[FMU_RUNG] = (int)output->rung;
    wholes[FMU_SOLVER] = (int)output->solver;
    wholes[FMU_ITERATIONS] = output->iterations;
    wholes[FMU_ACTIVE] = output->active;
    wholes[FMU_DOUBTS] = output->doubts;
}

fmu_status fmu_part_tune(fmu *instance)
{
    pcr_parameters parameters;
    memcpy(&parameters, instance->state.reals + FMU_PARAMETERS, sizeof parameters);
    if (pcr_controller_set_parameters(&instance->state.part, &parameters) != PCR_OK) {
        const int at = pcr_refused_parameter(&parameters);
        return fmu_say(instance, FMU_ERROR, "at %.9g s: %s = %g is refused: no robot or controller can have it beside "
                       "the others", instance->state.time, pcr_fmu_tunables[at], ((const double *)&parameters)[at]);
    }
    return FMU_OK;
}

fmu_status fmu_part_start(fmu *instance)
{
    fmu_state *state = &instance->state;
    const double *at = state->reals + FMU_START, *parameters = state->reals + FMU_PARAMETERS;
    pcr_output none;
    pcr_pose pose;
    memcpy(pose.p, at, sizeof pose.p);
    memcpy(pose.q, at + 2, sizeof pose.q);
    const int elsewhere = memcmp(at, pcr_fmu_starts + FMU_START, (2 + PCR_N) * sizeof *at) != 0;
    if (pcr_controller_init(&state->part, elsewhere ? &pose : NULL) != PCR_OK) {
        return fmu_say(instance, FMU_ERROR, "the rods cannot follow from the scene's start to p = (%g, %g) m with these "
                       "motor angles", pose.p[0], pose.p[1]);
    }
    if (memcmp(parameters, pcr_fmu_starts + FMU_PARAMETERS, PARAMETERS * sizeof *parameters) != 0
        && fmu_part_tune(instance) != FMU_OK) {
        return FMU_ERROR;
    }
    memset(&none, 0, sizeof none);
    none.primal_residual = none.dual_residual = none.stiffness = NAN;
    memcpy(none.estimate, pose.p, sizeof pose.p);
    memcpy(none.estimate + 4, pose.q, sizeof pose.q);
    show(instance, &none);
    return FMU_OK;
}

static fmu_status decide(fmu *instance)
{
    static const char *const rungs[] = {"the QP", "the QP, softened", "the last plan", "the LQR", "braking"};
    fmu_state *state = &instance->state;
    const double *in = state->reals;
    pcr_measurement measured;
    pcr_output output;
    memset(&measured, 0, sizeof measured);
    memcpy(measured.p, in + FMU_P, sizeof measured.p);
#ifdef FMU_V
    memcpy(measured.v, in + FMU_V, sizeof measured.v);
#endif
    memcpy(measured.q, in + FMU_Q, sizeof measured.q);
    if (in[FMU_GIVEN] != 0.0) {
        for (int i = FMU_GIVEN; i < FMU_INPUTS_END; i++) {
            if (!isfinite(in[i])) {
                return fmu_say(instance, FMU_ERROR, "at %.9g s: the input %s is %g", state->time, pcr_fmu_inputs[i], in[i]);
            }
        }
        measured.window = in + FMU_WINDOW;
    }
    const pcr_result result = pcr_controller_step(&state->part, &measured, &output);
    if (result != PCR_OK) {
        return fmu_say(instance, FMU_ERROR, "at %.9g s: the first measurement, p = (%g, %g) m, is in "
                       "other units, or angles are whole turns off (result %d)", state->time, measured.p[0], measured.p[1], (int)result);
    }
    show(instance, &output);
    if (output.rung < PCR_SHIFTED_PLAN) {
        return FMU_OK;
    }
    return fmu_say(instance, FMU_WARNING, "at %.9g s: answered by %s, as the QP was left with status %d", state->time,
                   rungs[output.rung], (int)output.solver);
}

fmu_status fmu_part_step(fmu *instance, double step)
{
    fmu_state *state = &instance->state;
    const double due = state->start + state->periods * PCR_PERIOD, slight = FMU_NEAR * PCR_PERIOD;
    const int decides = state->time >= due - slight;
    const double next = decides ? due + PCR_PERIOD : due;
    fmu_status found = FMU_OK;
    if (state->time + step > next + slight) {
        return fmu_say(instance, FMU_DISCARD, "at %.9g s: a step of %.9g s goes beyond %.9g s, when the controller "
                       "measures again: it has a period of %.9g s", state->time, step, next, PCR_PERIOD);
    }
    if (decides) {
        found = decide(instance);
        state->periods += found == FMU_ERROR ? 0.0 : 1.0;
    }
    state->time += found == FMU_ERROR ? 0.0 : step;
    return found;
}

void fmu_part_restore(fmu_part *part, const fmu_part *saved)
{
    pcr_controller_restore(part, saved);
}
