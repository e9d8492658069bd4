/* One control step: what is believed, what lies ahead, the plan, and what is foreseen for the next step. */
#include <math.h>
#include <stddef.h>
#include <string.h>

#include "pcr_graphs.h"
#include "pcr_parts.h"

#define NEAR 0.5  /* of `good`: another iteration will do */
#define AGAIN 3   /* evaluations at most for rods that are near */

static void foresee(pcr_controller *c)
{
    for (int i = 0; i < PCR_INS; i++) {
        c->arg[i] = c->in + pcr_in_places[i];
    }
    for (int i = 0; i < PCR_OUTS; i++) {
        c->res[i] = c->out + pcr_out_places[i];
    }
    pcr_graph_foresight(c->arg, c->res, c->iw, c->w);
}

/* Look ahead again from where the rods have come that are near, all places at once. Returns 0 if there are none. */
static int go_on(pcr_controller *c)
{
    const double *good = c->out + PCR_OUT_GOOD;
    int any = 0;
    for (int j = 0; j < PCR_PLACES; j++) {
        if (good[j] == NEAR) {
            memcpy(c->in + PCR_IN_RECORDS + j * PCR_RECORD, c->out + PCR_OUT_FOLLOWED + j * PCR_RECORD,
                   PCR_RECORD * sizeof *good);
            any = 1;
        }
    }
    if (good[PCR_PLACES] == NEAR) {
        memcpy(c->in + PCR_IN_TARGET, c->out + PCR_OUT_FOLLOWED_TARGET, PCR_TARGET * sizeof *good);
        any = 1;
    }
    if (any) {
        foresee(c);
    }
    return any;
}

/* More iterations for rods that have not followed, then the long way, one place after the other. Returns 0 if all
   have. */
static int bring_along(pcr_controller *c)
{
    const double *good = c->out + PCR_OUT_GOOD;
    double result[PCR_RESULT];
    const pcr_room room = pcr_room_of(c);
    for (int again = 0; again < AGAIN && go_on(c); again++) {
    }
    for (int j = 0; j < PCR_PLACES; j++) {
        if (good[j] < 1.0) {
            double x[PCR_STATES], *record = c->in + PCR_IN_RECORDS + j * PCR_RECORD;
            memcpy(x, c->out + PCR_OUT_PLACES + j * PCR_STATES, sizeof x);
            if (pcr_follow(&pcr_model_rods, c->parameters.numbers, x, x + 4, PCR_CLOSE, record, result, &room)) {
                return 1;
            }
            foresee(c);
            if (good[j] < 1.0) {
                return 1;
            }
        }
    }
    if (good[PCR_PLACES] < 1.0) {
        const double *end = c->in + PCR_IN_WINDOW + (PCR_HORIZON - 1) * PCR_ROW, *shift = c->in + PCR_IN_SHIFT;
        double q[PCR_N];
        for (int i = 0; i < PCR_N; i++) {
            q[i] = end[4 + i] + shift[i];
        }
        if (!pcr_follow(&pcr_target_rods, c->in + PCR_IN_TARGET_NUMBERS, end, q, 1e-2, c->in + PCR_IN_TARGET, result,
                        &room)) {
            foresee(c);
        }
    }
    return 0;
}

/* A row of the window: state at the end of a period, rates in it, and the force that the rods carry at its end. */
static void write_row(double *to, int row)
{
    const double *before = pcr_scene_reference[row], *at = pcr_scene_reference[row + 1];
    memcpy(to, at, PCR_STATES * sizeof *to);
    for (int i = 0; i < PCR_N; i++) {
        to[PCR_STATES + i] = (at[4 + i] - before[4 + i]) / PCR_PERIOD;
    }
    memcpy(to + PCR_STATES + PCR_N, at + PCR_STATES, 2 * sizeof *to);
}

/* Write what is known in this period besides the measurement. */
static void tell(pcr_controller *c, const pcr_measurement *measured)
{
    double *in = c->in, *window = in + PCR_IN_WINDOW, *path = in + PCR_IN_PATH;
    for (int j = 0; j < PCR_DELAY; j++) {
        memcpy(in + PCR_IN_ON_THE_WAY + j * PCR_N, c->on_the_way[j], sizeof c->on_the_way[j]);
    }
    memcpy(in + PCR_IN_U_PREVIOUS, c->u, sizeof c->u);
    if (measured->window != NULL) {
        memcpy(window, measured->window, PCR_HORIZON * PCR_ROW * sizeof *window);
    } else {
        for (int k = 0; k < PCR_HORIZON; k++) {
            if (c->period < PCR_PERIODS) {
                write_row(window + k * PCR_ROW, c->period + PCR_DELAY + k);
            } else {
                memcpy(window + k * PCR_ROW, pcr_scene_end, PCR_ROW * sizeof *window);
            }
        }
    }
    if (measured->payloads != NULL) {
        memcpy(in + PCR_IN_PAYLOADS, measured->payloads, PCR_PLACES * sizeof *in);
    } else {
        for (int j = 0; j < PCR_PLACES; j++) {
            const int row = c->period + j, last = PCR_PAYLOAD_ROWS - 1;
            in[PCR_IN_PAYLOADS + j] = pcr_scene_payloads[row < last ? row : last];
        }
    }
    for (int k = 0; k < PCR_MODELS - 1; k++) {
        /* The last plan, one period on; at the start the reference. */
        memcpy(path + k * PCR_STATES, c->has_plan && c->has_states ? c->states[k + 2] : window + k * PCR_ROW,
               PCR_STATES * sizeof *path);
    }
}

/* State one period later by a linear model. */
static void predict(const double *model, const double *x, const double *u, double *next)
{
    const double *constant = model + PCR_STATES * PCR_STATES, *b = constant + PCR_STATES;
    double moved[PCR_STATES];
    for (int i = 0; i < PCR_STATES; i++) {
        moved[i] = constant[i];
        for (int j = 0; j < PCR_STATES; j++) {
            moved[i] += model[i + PCR_STATES * j] * x[j];
        }
        for (int j = 0; j < PCR_N; j++) {
            moved[i] += b[i + PCR_STATES * j] * u[j];
        }
    }
    memcpy(next, moved, sizeof moved);
}

/* Whether numbers that were handed in are finite and not less than that; none are. */
static int sound(const double *values, int count, double least)
{
    for (int i = 0; values != NULL && i < count; i++) {
        if (!(isfinite(values[i]) && values[i] >= least)) {
            return 0;
        }
    }
    return 1;
}

pcr_result pcr_controller_step(pcr_controller *c, const pcr_measurement *measured, pcr_output *output)
{
    if (c == NULL || !c->started) {
        return PCR_NOT_STARTED;
    }
    if (measured == NULL || output == NULL || !sound(measured->window, PCR_HORIZON * PCR_ROW, -INFINITY)
        || !sound(measured->payloads, PCR_PLACES, 0.0)) {
        return PCR_ARGUMENT;
    }
    memset(output, 0, sizeof *output);
    const pcr_result believed = pcr_believe(c, measured, &output->doubts);
    if (believed != PCR_OK) {
        output->rung = PCR_HOLD;
        output->solver = PCR_QP_NO_MODEL;
        return believed;
    }
    tell(c, measured);
    foresee(c);
    double *in = c->in, *out = c->out, *ahead = out + PCR_OUT_AHEAD;
    const double strayed = out[PCR_OUT_DECISIONS + 1];
    double corrected[PCR_STATES + 2], foreseen[PCR_STATES];
    pcr_pose_limits limits;
    limits.kinds = limits.count = 0;
    /* So written that NaN is a failure. */
    int failed = !(out[PCR_OUT_DECISIONS] >= 1.0) && bring_along(c);
    memcpy(corrected, out + PCR_OUT_CORRECTED, sizeof corrected);
    if (!failed) {
        /* What the next period starts from: in it each place is where its neighbour is now. */
        memcpy(in + PCR_IN_RECORDS, out + PCR_OUT_NEXT, PCR_NEXT * sizeof *in);
        failed = pcr_near(c, &limits);
    } else {
        memcpy(in + PCR_IN_RECKONED, out + PCR_OUT_RECKONED, PCR_N * sizeof *in);
    }
    if (failed) {
        double wanted[PCR_STATES];
        memcpy(wanted, in + PCR_IN_WINDOW, sizeof wanted);
        for (int i = 0; i < PCR_N; i++) {
            wanted[4 + i] += in[PCR_IN_SHIFT + i];
        }
        pcr_fall_back(c, corrected, wanted, in + PCR_IN_WINDOW, output);
        output->solver = PCR_QP_NO_MODEL;
        ahead = corrected;
    } else {
        pcr_decide(c, &limits, output);
    }

    /* The first rates within the stops for the sum of the commands too: a wrong angle may be measured. */
    double u[PCR_N];
    memcpy(u, c->inputs[0], sizeof u);
    int as_planned = 1;
    if (failed || !(strayed <= PCR_SAME_ANGLE)) {
        pcr_kept(c, c->inputs[0], c->u, ahead + 4, out + PCR_OUT_RECKONED, u);
        for (int i = 0; i < PCR_N; i++) {
            as_planned = as_planned && u[i] == c->inputs[0][i];
        }
        output->active |= as_planned ? 0 : PCR_LIMIT_ANGLE;
    }
    memcpy(output->inputs, c->inputs, sizeof output->inputs);
    memcpy(output->inputs[0], u, sizeof u);
    memcpy(c->u, u, sizeof u);
    memcpy(c->on_the_way[PCR_DELAY], u, sizeof u);
    memcpy(c->turning, c->on_the_way[0], sizeof u);
    memmove(c->on_the_way[0], c->on_the_way[1 - (PCR_DELAY == 0)], PCR_DELAY * sizeof u);

    /* The state at the next measurement. */
    const int fallen = output->rung != PCR_SOLVED;
    if (!failed && PCR_DELAY > 0) {
        memcpy(c->predicts, out + PCR_OUT_NOW, sizeof c->predicts);
        memcpy(foreseen, out + PCR_OUT_ARRIVING, sizeof foreseen);
    } else {
        if (!failed) {
            /* A plan of commanded angles has models and states of these. */
            memcpy(c->predicts, out + (PCR_COMMANDED ? PCR_OUT_FIRST : PCR_OUT_MODELS), sizeof c->predicts);
        }
        if (as_planned && PCR_DELAY == 0 && !PCR_COMMANDED && c->has_states && !fallen) {
            memcpy(foreseen, c->states[1], sizeof foreseen);
        } else {
            predict(c->predicts, corrected, c->turning, foreseen);
        }
    }
    memcpy(output->u, u, sizeof u);
    memcpy(output->estimate, corrected, sizeof output->estimate);
    memcpy(output->force, corrected + PCR_STATES, sizeof output->force);
    output->stiffness = out[PCR_OUT_SIGNS];
    memcpy(output->torque, out + PCR_OUT_SIGNS + 1, sizeof output->torque);
    for (int k = 0; k <= PCR_HORIZON; k++) {
        for (int i = 0; i < PCR_STATES; i++) {
            output->states[k][i] = c->has_states ? c->states[k][i] : NAN;
        }
    }
    if (PCR_PAST) {
        pcr_past_remember(c, corrected, c->predicts);
    }
    memcpy(in + PCR_IN_ESTIMATE, foreseen, sizeof foreseen);
    memcpy(in + PCR_IN_ESTIMATE + PCR_STATES, corrected + PCR_STATES, 2 * sizeof *in);
    c->period += c->period < PCR_PERIODS + PCR_PAYLOAD_ROWS;
    return PCR_OK;
}
