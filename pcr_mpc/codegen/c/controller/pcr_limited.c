/* The QP with soft rows, in coordinates V = L'U in which its cost is 1/2 |V - V*|^2, every row scaled to length one:

                         V                  s-     s+
    rates, changes     [ A inv(L')                    ]
    angles, poses      [ A inv(L')          1      -1 ]
    slacks             [                    1         ]
                       [                           1  ]

   One workspace serves all combinations of limits that may be near; what a solver of each would remember is kept. */
#include "pcr_limited.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

#include "pcr_tables.h"

#define TOLERANCE (10.0 * PCR_TOLERANCE)
#define SLACK_SEEN 1e-4

static const pcr_qp_settings settings = {TOLERANCE, PCR_MAX_ITERATIONS};

static int rows_of(int kinds)
{
    int count = 0;
    for (int k = 0; k < PCR_POSE_KINDS; k++) {
        count += (kinds >> k) & 1 ? pcr_kind_rows[k] : 0;
    }
    return count;
}

void pcr_limited_reset(pcr_limited *limited, double penalty)
{
    limited->kinds = -1;
    limited->penalty = penalty;
    for (int k = 0; k < 1 << PCR_POSE_KINDS; k++) {
        limited->kept[k].used = limited->kept[k].solved = 0;
    }
}

/* Remember what the solver at work has found. */
static void put_away(pcr_limited *limited)
{
    if (limited->kinds < 0) {
        return;
    }
    const pcr_qp *qp = &limited->qp;
    pcr_limited_state *state = &limited->kept[limited->kinds];
    const int n = qp->shape->n, m = qp->shape->m;
    double *last = limited->last + pcr_limited_places[limited->kinds];
    state->used = 1;
    state->memory = pcr_qp_memory(qp);
    memcpy(last, qp->solution.x, (size_t)n * sizeof *last);
    memcpy(last + n, qp->solution.y, (size_t)m * sizeof *last);
}

/* Let the solver of these kinds go on from where it was. */
static int fetch(pcr_limited *limited, int kinds)
{
    if (limited->kinds == kinds) {
        return 0;
    }
    put_away(limited);
    limited->kinds = -1;
    const int size = PCR_INPUTS, soft = size + PCR_HORIZON * rows_of(kinds), rows = 2 * size + soft;
    int e = 0;
    for (int j = 0; j < size; j++) {
        limited->starts[j] = e;
        for (int i = 0; i < rows; i++, e++) {
            limited->rows[e] = i;
        }
    }
    for (int j = 0; j < 2 * soft; j++) {
        limited->starts[size + j] = e;
        limited->rows[e++] = 2 * size + j % soft;
        limited->rows[e++] = rows + j;
    }
    limited->starts[size + 2 * soft] = e;
    pcr_qp *qp = &limited->qp;
    if (pcr_qp_setup(qp, &pcr_limited_shapes[kinds], &settings, limited->starts, limited->rows, NULL,
                     limited->doubles, limited->ints)) {
        return PCR_LEFT_NOT_CONVEX;
    }
    const pcr_limited_state *state = &limited->kept[kinds];
    if (state->used) {
        const double *last = limited->last + pcr_limited_places[kinds];
        pcr_qp_resume(qp, last, last + qp->shape->n, state->solved, state->memory);
    }
    limited->kinds = kinds;
    return 0;
}

void pcr_limited_restore(pcr_limited *limited, const pcr_limited *saved)
{
    memmove(limited, saved, sizeof *limited);
    if (saved->kinds >= 0) {
        pcr_qp_setup(&limited->qp, &pcr_limited_shapes[saved->kinds], &settings, limited->starts, limited->rows, NULL,
                     limited->doubles, limited->ints);
        memcpy(limited->doubles, saved->doubles, sizeof limited->doubles);
        memcpy(limited->ints, saved->ints, sizeof limited->ints);
        pcr_qp_restore(&limited->qp, &saved->qp);
    }
}

/* Move multipliers, or slacks, on by one period; the last period's stay. */
static double *moved_on(double *to, const double *from, int width)
{
    for (int i = 0; i < PCR_HORIZON * width; i++) {
        to[i] = from[i + width < PCR_HORIZON * width ? i + width : i];
    }
    return to + PCR_HORIZON * width;
}

static void start_from(pcr_limited *limited, int count, const double *warm)
{
    const int size = PCR_INPUTS;
    double x[PCR_LIMITED_N] = {0.0}, y[PCR_LIMITED_M] = {0.0};
    if (limited->kept[limited->kinds].solved) {
        const double *from = limited->qp.solution.y;
        double *to = y;
        for (int block = 0; block < 3; block++) {
            to = moved_on(to, from + (to - y), PCR_N);
        }
        to = moved_on(to, from + (to - y), count);
        for (int side = 0; side < 2; side++) {
            to = moved_on(to, from + (to - y), PCR_N);
            to = moved_on(to, from + (to - y), count);
        }
        from = limited->qp.solution.x + size;
        to = x + size;
        for (int side = 0; side < 2; side++) {
            to = moved_on(to, from + (to - x - size), PCR_N);
            to = moved_on(to, from + (to - x - size), count);
        }
    }
    for (int i = 0; i < size; i++) {
        for (int j = i; j < size; j++) {
            x[i] += limited->factor[j][i] * warm[j];
        }
    }
    pcr_qp_warm_start(&limited->qp, x, y);
}

static double worst(double a, double b)
{
    return a > b ? a : b;
}

static void explain(const pcr_limited *limited, const pcr_pose_limits *limits, double dt, const double *x,
                    const double *y, pcr_limited_answer *answer)
{
    const int size = PCR_INPUTS, count = limits == NULL ? 0 : limits->count, soft = size + PCR_HORIZON * count;
    memset(answer->pull, 0, sizeof answer->pull);
    memset(answer->slack, 0, sizeof answer->slack);
    for (int i = 0; i < 3 * size; i++) {
        answer->pull[i / size] = worst(answer->pull[i / size], fabs(y[i]));
    }
    for (int i = 0; i < soft; i++) {
        const double given = dt * worst(x[size + i], x[size + soft + i]) * limited->length[2 * size + i];
        if (i < size) {
            answer->slack[0] = worst(answer->slack[0], given > SLACK_SEEN ? given : 0.0);
            continue;
        }
        const int row = (i - size) % count, kind = limits->kind[row];
        answer->pull[3 + kind] = worst(answer->pull[3 + kind], fabs(y[2 * size + i]));
        if (given * limits->scale[row] > SLACK_SEEN * limits->scale[row]) {
            answer->slack[1 + kind] = worst(answer->slack[1 + kind], given * limits->scale[row]);
        }
    }
}

/* Residuals of a solution, from the data that were handed over. */
static void judge(const pcr_limited *limited, int count, const double *x, const double *y, pcr_limited_answer *answer)
{
    const int size = PCR_INPUTS, soft = size + PCR_HORIZON * count, rows = 2 * size + soft;
    double primal = 0.0, dual = 0.0;
    for (int i = 0; i < rows + 2 * soft; i++) {
        double value = i >= rows ? x[size + i - rows] : 0.0;
        for (int j = 0; j < size && i < rows; j++) {
            value += limited->stacked[j][i] * x[j];
        }
        if (i >= 2 * size && i < rows) {
            value += x[size + i - 2 * size] - x[size + soft + i - 2 * size];
        }
        primal = worst(primal, worst(limited->l[i] - value, value - limited->u[i]));
    }
    for (int j = 0; j < size + 2 * soft; j++) {
        double value = x[j] + limited->q[j];
        for (int i = 0; i < rows && j < size; i++) {
            value += limited->stacked[j][i] * y[i];
        }
        if (j >= size) {
            const double tied = y[2 * size + (j - size) % soft];
            value += (j < size + soft ? tied : -tied) + y[rows + j - size];
        }
        dual = worst(dual, fabs(value));
    }
    answer->primal_residual = primal;
    answer->dual_residual = dual;
}

void pcr_limited_solve(pcr_limited *limited, const double *p, const double *q, const double *l, const double *u,
                       const double *models, const double *x, double dt, const pcr_pose_limits *limits,
                       int soft_angles, const double *warm, int most, pcr_limited_answer *answer)
{
    const int kinds = limits == NULL ? 0 : limits->kinds, count = limits == NULL ? 0 : limits->count;
    const int size = PCR_INPUTS, soft = size + PCR_HORIZON * count, rows = 2 * size + soft;
    double (*a)[PCR_LIMITED_ROWS] = limited->stacked;

    answer->iterations = 0;
    answer->left = PCR_LEFT_NOT_CONVEX;
    if (pcr_factorise(limited->factor, p) || fetch(limited, kinds)) {
        return;
    }
    memcpy(limited->l, l, PCR_MOTOR_ROWS * sizeof *l);
    memcpy(limited->u, u, PCR_MOTOR_ROWS * sizeof *u);
    pcr_stack(limited, models, x, dt, limits, limited->l, limited->u);
    /* A inv(L'), column by column; and L q' = q. */
    double longest = 0.0;
    for (int j = 0; j < size; j++) {
        double sum = q[j];
        for (int k = 0; k < j; k++) {
            sum -= limited->factor[j][k] * limited->q[k];
        }
        limited->q[j] = sum / limited->factor[j][j];
        for (int i = 0; i < rows; i++) {
            double entry = a[j][i];
            for (int k = 0; k < j; k++) {
                entry -= limited->factor[j][k] * a[k][i];
            }
            a[j][i] = entry / limited->factor[j][j];
        }
    }
    for (int i = 0; i < rows; i++) {
        double square = 0.0;
        for (int j = 0; j < size; j++) {
            square += a[j][i] * a[j][i];
        }
        limited->length[i] = sqrt(square);
        longest = worst(longest, limited->length[i]);
    }
    int crossed = 0;
    for (int i = 0; i < rows; i++) {
        limited->length[i] = worst(limited->length[i], 1e-12 * longest);
        limited->l[i] = worst(limited->l[i] / limited->length[i], -PCR_INFINITY);
        limited->u[i] = -worst(-limited->u[i] / limited->length[i], -PCR_INFINITY);
        crossed = crossed || !(limited->l[i] <= limited->u[i]);
        for (int j = 0; j < size; j++) {
            a[j][i] /= limited->length[i];
        }
    }
    for (int j = 0; j < 2 * soft; j++) {
        limited->q[size + j] = limited->penalty;
        limited->l[rows + j] = 0.0;
        limited->u[rows + j] = j % soft < size && !soft_angles ? 0.0 : PCR_INFINITY;
    }
    if (crossed) {
        answer->left = PCR_LEFT_CROSSED;
        return;
    }
    pcr_qp *qp = &limited->qp;
    pcr_qp_write(qp, a[0], PCR_LIMITED_ROWS, rows);
    answer->left = pcr_qp_update(qp, NULL, 1, limited->q, limited->l, limited->u);
    if (answer->left) {
        pcr_limited_reset(limited, limited->penalty);
        return;
    }
    if (warm != NULL) {
        start_from(limited, count, warm);
    }
    limited->kept[kinds].solved = 0;
    answer->left = pcr_qp_solve(qp, most, &answer->iterations);
    if (answer->left) {
        return;
    }
    const double *v = qp->solution.x, *y = qp->solution.y;
    judge(limited, count, v, y, answer);
    answer->left = pcr_qp_judge(qp, answer->primal_residual, answer->dual_residual);
    if (answer->left) {
        return;
    }
    limited->kept[kinds].solved = 1;
    for (int i = size - 1; i >= 0; i--) {
        double sum = v[i];
        for (int k = i + 1; k < size; k++) {
            sum -= limited->factor[k][i] * answer->inputs[k];
        }
        answer->inputs[i] = sum / limited->factor[i][i];
    }
    explain(limited, limits, dt, v, y, answer);
}
