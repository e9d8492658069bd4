/* A controller before its first step, with other parameters, or as a copy of another one. */
#include <math.h>
#include <stddef.h>
#include <string.h>

#include "pcr_parts.h"

static void write_parameters(pcr_controller *c)
{
    const pcr_parameters *of = &c->parameters;
    double *in = c->in, *check = c->check_in;
    memcpy(in + PCR_IN_NUMBERS, of->numbers, sizeof of->numbers);
    /* Rods that are solved in another way have other numbers besides. */
    for (int i = 0; i < PCR_TARGET_NUMBERS; i++) {
        const int at = pcr_target_places[i];
        in[PCR_IN_TARGET_NUMBERS + i] = at < 0 ? pcr_scene_target_numbers[i] : of->numbers[at];
    }
    for (int i = 0; i < PCR_WATCH_NUMBERS; i++) {
        const int at = pcr_watch_places[i];
        c->watch_numbers[i] = at < 0 ? pcr_scene_watch_numbers[i] : of->numbers[at];
    }
    memcpy(in + PCR_IN_WEIGHTS, of->weights, sizeof of->weights);
    memcpy(in + PCR_IN_TERMINAL, of->terminal, sizeof of->terminal);
    memcpy(in + PCR_IN_GAIN, of->observer_gain, sizeof of->observer_gain);
    in[PCR_IN_HALF_STEP] = PCR_OBSERVER ? PCR_ANGLE_STEP / 2.0 : 0.0;
    in[PCR_IN_CARRIES] = PCR_OBSERVER;
    in[PCR_IN_DT] = PCR_PERIOD;
    in[PCR_IN_PULL] = PCR_PULL;
    in[PCR_IN_PRIOR] = PCR_PRIOR_LAG;
    in[PCR_IN_PRIOR + 1] = PCR_PRIOR;
    for (int i = 0; i < PCR_N; i++) {
        in[PCR_IN_BOUNDS + i] = of->rate;
        in[PCR_IN_BOUNDS + PCR_N + i] = of->rate_change;
        in[PCR_IN_BOUNDS + 2 * PCR_N + i] = of->angle_lower[i];
        in[PCR_IN_BOUNDS + 3 * PCR_N + i] = of->angle_upper[i];
    }
    memcpy(check + PCR_CHECK_BOUNDS, in + PCR_IN_BOUNDS, 4 * PCR_N * sizeof *in);
    c->clear = pcr_clear_way(of);
    check[PCR_CHECK_DT] = PCR_PERIOD;
    check[PCR_CHECK_CLEAR] = c->clear;
}

pcr_result pcr_controller_init(pcr_controller *c, const pcr_pose *pose)
{
    const pcr_pose *at = pose == NULL ? &pcr_scene_pose : pose;
    double result[PCR_RESULT];
    if (c == NULL) {
        return PCR_ARGUMENT;
    }
    memset(c, 0, sizeof *c);
    c->parameters = pcr_scene_parameters;
    double *x = c->in + PCR_IN_ESTIMATE, *record = c->in + PCR_IN_RECORDS, *target = c->in + PCR_IN_TARGET;
    memcpy(x, at->p, sizeof at->p);
    memcpy(x + 4, at->q, sizeof at->q);
    for (int i = 0; i < PCR_STATES; i++) {
        if (!isfinite(x[i])) {
            return PCR_ARGUMENT;
        }
    }
    memcpy(record, pcr_scene_record, sizeof pcr_scene_record);
    memcpy(target, pcr_scene_target_record, sizeof pcr_scene_target_record);
    memcpy(c->predicts, pcr_scene_model, sizeof pcr_scene_model);
    memcpy(c->in + PCR_IN_MASS, pcr_scene_mass, sizeof pcr_scene_mass);
    write_parameters(c);
    memcpy(c->watch_record, pcr_scene_watch_record, sizeof pcr_scene_watch_record);
    memcpy(c->watch_result, pcr_scene_watch_result, sizeof pcr_scene_watch_result);
    memcpy(c->watch_at, at->p, sizeof at->p);
    memcpy(c->watch_at + 2, at->q, sizeof at->q);
    if (pose != NULL) {
        const pcr_room room = pcr_room_of(c);
        if (pcr_follow(&pcr_model_rods, c->parameters.numbers, at->p, at->q, PCR_CLOSE, record, result, &room)
            || pcr_follow(&pcr_target_rods, c->in + PCR_IN_TARGET_NUMBERS, at->p, at->q, PCR_CLOSE, target, result,
                          &room)
            || pcr_follow(&pcr_watch_rods, c->watch_numbers, at->p, at->q, PCR_CLOSE, c->watch_record,
                          c->watch_result, &room)) {
            return PCR_OUT_OF_REACH;
        }
        /* The linear model at rest, about this pose. */
        double *constant = c->predicts + PCR_STATES * PCR_STATES;
        for (int i = 0; i < PCR_STATES; i++) {
            constant[i] = x[i];
            for (int j = 0; j < PCR_STATES; j++) {
                constant[i] -= c->predicts[i + PCR_STATES * j] * x[j];
            }
        }
    }
    for (int j = 1; j < PCR_PLACES; j++) {
        memcpy(record + j * PCR_RECORD, record, PCR_RECORD * sizeof *record);
    }
    memcpy(c->in + PCR_IN_RECKONED, at->q, sizeof at->q);
    pcr_gate_start(c, at->q);
    pcr_law_reset(c);
    c->started = 1;
    return PCR_OK;
}

pcr_result pcr_controller_set_parameters(pcr_controller *c, const pcr_parameters *parameters)
{
    if (c == NULL || !c->started) {
        return PCR_NOT_STARTED;
    }
    if (parameters == NULL || pcr_refused_parameter(parameters) >= 0) {
        return PCR_ARGUMENT;
    }
    const int has_plan = c->has_plan, has_states = c->has_states, age = c->age;
    c->parameters = *parameters;
    write_parameters(c);
    c->watch_at[0] = NAN; /* what was found there was another robot's */
    pcr_law_reset(c);
    c->has_plan = has_plan;
    c->has_states = has_states;
    c->age = age;
    return PCR_OK;
}

pcr_result pcr_controller_restore(pcr_controller *c, const pcr_controller *saved)
{
    if (c == NULL || saved == NULL || c == saved) {
        return PCR_ARGUMENT;
    }
    if (!saved->started) {
        return PCR_NOT_STARTED;
    }
    memcpy(c, saved, sizeof *c);
    pcr_law_restore(c, saved);
    return PCR_OK;
}

unsigned long pcr_controller_size(void)
{
    return sizeof(pcr_controller);
}
