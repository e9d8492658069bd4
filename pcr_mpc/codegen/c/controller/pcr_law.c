/* The linear MPC from its QP on. */
#include <math.h>
#include <string.h>

#include "pcr_parts.h"

#define JUMP 1e3
#define SLIGHT 1e-6
#define FEWEST_ITERATIONS 10
#define COUNTS 1e-9
#define UNIT (100.0 * PCR_PERIOD)

static const pcr_qp_settings rates_settings = {PCR_TOLERANCE, PCR_MAX_ITERATIONS};

static void reset_rates(pcr_controller *c)
{
    pcr_qp_setup(&c->rates, &pcr_rates_shape, &rates_settings, pcr_rates_starts, pcr_rates_rows, pcr_rates_values,
                 c->rates_doubles, c->rates_ints);
}

void pcr_law_restore(pcr_controller *c, const pcr_controller *saved)
{
    reset_rates(c);
    memcpy(c->rates_doubles, saved->rates_doubles, sizeof c->rates_doubles);
    memcpy(c->rates_ints, saved->rates_ints, sizeof c->rates_ints);
    pcr_qp_restore(&c->rates, &saved->rates);
    pcr_limited_restore(&c->limited, &saved->limited);
}

static void reset_solvers(pcr_controller *c)
{
    c->limits_matter = c->unlimited = 0;
    reset_rates(c);
    pcr_limited_reset(&c->limited, PCR_PENALTY * c->parameters.weights[0] * c->parameters.reach * c->parameters.reach);
}

void pcr_law_reset(pcr_controller *c)
{
    c->has_plan = c->has_states = c->has_models = c->has_problem = 0;
    c->age = -1;
    reset_solvers(c);
}

/* Whether the last solution is a start for a problem of these sizes; NaN continues nothing. */
static int continues(const pcr_controller *c, double hessian, double gradient)
{
    const double rate = c->parameters.rate;
    if (!c->has_problem) {
        return 1;
    }
    if (!(hessian <= JUMP * c->hessian && JUMP * c->hessian <= JUMP * JUMP * hessian)) {
        return 0;
    }
    if (c->gradient <= JUMP * gradient) {
        return 1;
    }
    const double slight = SLIGHT * hessian * (rate < INFINITY ? rate : 1.0 / UNIT);
    return gradient < slight && c->gradient <= JUMP * slight;
}

static int active_of(const double *pulls, const int *bits, int count)
{
    double largest = 0.0;
    int active = 0;
    for (int i = 0; i < count; i++) {
        largest = pulls[i] > largest ? pulls[i] : largest;
    }
    for (int i = 0; i < count && largest >= COUNTS; i++) {
        active |= pulls[i] > 1e-6 * largest ? bits[i] : 0;
    }
    return active;
}

/* The optimum without limits, if it keeps them all. Returns 1 if that is the answer. */
static int solve_without_limits(pcr_controller *c, const pcr_pose_limits *limits, double *inputs, pcr_output *output)
{
    const double *found = c->check_out + (PCR_HORIZON + 1) * PCR_STATES, *decisions = c->out + PCR_OUT_DECISIONS;
    const double tolerance = PCR_TOLERANCE * (UNIT + decisions[3] / sqrt((double)PCR_INPUTS));
    if (!(decisions[4] > 0.0)) {
        return 0;
    }
    memcpy(c->check_in + PCR_CHECK_INPUTS, c->out + PCR_OUT_FREE, PCR_INPUTS * sizeof *found);
    memset(c->check_in + PCR_CHECK_Y, 0, 2 * PCR_INPUTS * sizeof *found);
    pcr_check(c);
    if (!(found[5] > 0.0) || found[0] > 0.0 || found[2] > 0.0 || !(found[1] <= tolerance)
        || pcr_broken_by(c, limits, found[2]) > 0.0) {
        return 0;
    }
    memcpy(inputs, c->out + PCR_OUT_FREE, PCR_INPUTS * sizeof *inputs);
    memcpy(c->states, c->check_out, sizeof c->states);
    output->active = 0;
    output->primal_residual = found[0];
    output->dual_residual = 1.0 / UNIT * found[1];
    output->iterations = 1; /* as an active-set method counts it */
    output->solver = PCR_QP_SOLVED;
    c->unlimited = 1;
    return 1;
}

/* Solve with the rows of the rates alone. Returns 1 if that is the answer. */
static int solve_rates(pcr_controller *c, const pcr_pose_limits *limits, const double *warm, int *spent,
                       double *inputs, int *kept, pcr_output *output)
{
    static const int bits[2] = {PCR_LIMIT_RATE, PCR_LIMIT_RATE_CHANGE};
    const double rate = 1.0 / UNIT;
    double *in = c->check_in, *p = in + PCR_CHECK_P, *q = in + PCR_CHECK_Q, *l = in + PCR_CHECK_L;
    double *u = in + PCR_CHECK_U, start[PCR_INPUTS];
    double scaled[PCR_TRIANGLE + PCR_INPUTS + 4 * PCR_INPUTS];
    int left, sound = c->out[PCR_OUT_DECISIONS + 4] > 0.0;
    if (rate != 1.0) {
        double *to = scaled;
        for (int i = 0; i < PCR_TRIANGLE; i++) {
            *to++ = rate * rate * p[i];
        }
        for (int i = 0; i < PCR_INPUTS; i++) {
            *to++ = rate * q[i];
        }
        for (int i = 0; i < 2 * PCR_INPUTS; i++) {
            *to++ = l[i] / rate;
        }
        for (int i = 0; i < 2 * PCR_INPUTS; i++) {
            *to++ = u[i] / rate;
        }
        p = scaled;
        q = p + PCR_TRIANGLE;
        l = q + PCR_INPUTS;
        u = l + 2 * PCR_INPUTS;
    }
    if (!sound) {
        output->solver = PCR_QP_CROSSED;
        for (int i = 0; i < PCR_TRIANGLE; i++) {
            if (!isfinite(p[i])) {
                output->solver = PCR_QP_NOT_CONVEX;
                return 0;
            }
        }
        for (int i = 0; i < 2 * PCR_INPUTS; i++) {
            if (!(l[i] <= u[i]) || (i < PCR_INPUTS && !isfinite(q[i]))) {
                return 0;
            }
        }
    }
    left = pcr_qp_update(&c->rates, p, 0, q, l, u);
    if (left) {
        output->solver = (pcr_qp_status)left;
        reset_rates(c);
        return 0;
    }
    if (warm != NULL) {
        static const double none[2 * PCR_INPUTS]; /* multipliers */
        for (int i = 0; i < PCR_INPUTS; i++) {
            start[i] = warm[i] / rate;
        }
        pcr_qp_warm_start(&c->rates, start, c->unlimited ? none : NULL);
    }
    int iterations;
    left = pcr_qp_solve(&c->rates, PCR_MAX_ITERATIONS, &iterations);
    *spent = iterations;
    if (left) {
        output->solver = (pcr_qp_status)left;
        return 0;
    }
    c->unlimited = 0;
    for (int i = 0; i < PCR_INPUTS; i++) {
        in[PCR_CHECK_INPUTS + i] = inputs[i] = rate * c->rates.solution.x[i];
    }
    for (int i = 0; i < 2 * PCR_INPUTS; i++) {
        in[PCR_CHECK_Y + i] = c->rates.solution.y[i] / rate;
    }
    pcr_check(c);
    const double *found = c->check_out + (PCR_HORIZON + 1) * PCR_STATES;
    left = pcr_qp_judge(&c->rates, found[0] / rate, rate * found[1]);
    if (left) {
        output->solver = (pcr_qp_status)left;
        return 0;
    }
    if (!(pcr_broken_by(c, limits, found[2]) <= PCR_TOLERANCE * rate * PCR_PERIOD)) {
        return 0;
    }
    const double pulls[2] = {rate * found[3], rate * found[4]};
    output->active = active_of(pulls, bits, 2);
    output->primal_residual = found[0] / rate;
    output->dual_residual = rate * found[1];
    output->iterations = iterations;
    output->solver = PCR_QP_SOLVED;
    *kept = found[5] > 0.0;
    memcpy(c->states, c->check_out, sizeof c->states);
    return 1;
}

/* Solve with everything; returns 0 if that is the answer. */
static int solve_whole(pcr_controller *c, const pcr_pose_limits *limits, const double *warm, int soft_angles,
                       int *spent, double *inputs, pcr_output *output)
{
    const double *in = c->check_in;
    int bits[3 + PCR_POSE_KINDS] = {PCR_LIMIT_RATE, PCR_LIMIT_RATE_CHANGE, PCR_LIMIT_ANGLE};
    pcr_limited_answer answer;
    if (PCR_MAX_ITERATIONS - *spent < FEWEST_ITERATIONS) {
        output->solver = PCR_QP_ITERATIONS;
        return 1;
    }
    pcr_limited_solve(&c->limited, in + PCR_CHECK_P, in + PCR_CHECK_Q, in + PCR_CHECK_L, in + PCR_CHECK_U,
                      in + PCR_CHECK_MODELS, in + PCR_CHECK_X, PCR_PERIOD, limits->count ? limits : NULL, soft_angles,
                      warm, PCR_MAX_ITERATIONS - *spent, &answer);
    *spent += answer.iterations;
    output->solver = (pcr_qp_status)answer.left;
    if (answer.left) {
        return 1;
    }
    for (int k = 0; k < PCR_POSE_KINDS; k++) {
        bits[3 + k] = pcr_kind_bits[k];
    }
    output->active = active_of(answer.pull, bits, 3 + PCR_POSE_KINDS);
    output->iterations = *spent;
    output->primal_residual = answer.primal_residual;
    output->dual_residual = answer.dual_residual;
    c->limits_matter = (output->active & ~(PCR_LIMIT_RATE | PCR_LIMIT_RATE_CHANGE)) != 0;
    for (int k = 0; k <= PCR_POSE_KINDS; k++) {
        const int bit = bits[2 + k];
        for (int b = 0; b < 8; b++) {
            if (bit == 1 << b && answer.slack[k] > 0.0) {
                output->slack[b] = answer.slack[k];
                output->rung = PCR_SOFTENED;
            }
        }
    }
    memcpy(inputs, answer.inputs, sizeof answer.inputs);
    return 0;
}

void pcr_decide(pcr_controller *c, const pcr_pose_limits *limits, pcr_output *output)
{
    const double *out = c->out, *x = out + PCR_OUT_AHEAD;
    const double hessian = out[PCR_OUT_DECISIONS + 2], gradient = out[PCR_OUT_DECISIONS + 3];
    double shifted[PCR_INPUTS], inputs[PCR_INPUTS];
    const double *warm = NULL;
    int spent = 0, kept = 0, solved = 0;
    if (!continues(c, hessian, gradient)) {
        c->has_plan = c->has_states = c->has_models = c->has_problem = 0;
        c->age = -1;
        reset_solvers(c);
    }
    if (c->has_plan && c->has_problem) {
        memcpy(shifted, c->inputs[PCR_HORIZON > 1 ? 1 : 0], (PCR_INPUTS - PCR_N) * sizeof *shifted);
        memcpy(shifted + PCR_INPUTS - PCR_N, c->inputs[PCR_HORIZON - 1], PCR_N * sizeof *shifted);
        warm = shifted;
    }
    c->has_problem = 1;
    c->hessian = hessian;
    c->gradient = gradient;
    memcpy(c->check_in, out + PCR_OUT_MODELS, PCR_CHECK_BOUNDS * sizeof *out); /* models to bounds */

    output->rung = PCR_SOLVED;
    if (!c->limits_matter) {
        kept = solved = solve_without_limits(c, limits, inputs, output);
        solved = solved || solve_rates(c, limits, warm, &spent, inputs, &kept, output);
        if (!solved && spent && output->solver == PCR_QP_SOLVED) {
            memcpy(shifted, inputs, sizeof shifted);
            warm = shifted;
        }
    }
    const int predicted = solved;
    if (!solved) {
        kept = 0;
        if (solve_whole(c, limits, warm, 0, &spent, inputs, output)) {
            const pcr_qp_status why = output->solver;
            if (solve_whole(c, limits, NULL, 1, &spent, inputs, output)) {
                pcr_fall_back(c, x, out + PCR_OUT_WANTED, c->in + PCR_IN_WINDOW, output);
                return;
            }
            output->rung = PCR_SOFTENED;
            output->solver = why;
        }
    }
    memcpy(c->inputs, inputs, sizeof inputs);
    if (!kept) {
        double first[PCR_N];
        pcr_kept(c, inputs, c->u, x + 4, NULL, first);
        if (!predicted || memcmp(first, inputs, sizeof first) != 0) {
            memcpy(c->inputs[0], first, sizeof first);
            pcr_predict_states(c, out + PCR_OUT_MODELS, x);
        }
    }
    memcpy(c->models, out + PCR_OUT_MODELS, sizeof c->models);
    c->has_plan = c->has_states = c->has_models = 1;
    c->age = 0;
}
