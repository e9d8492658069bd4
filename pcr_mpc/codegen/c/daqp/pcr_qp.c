/* DAQP's set-up without an allocator, and what is done about what it leaves to its caller: see daqp_solver.py. */
#include "pcr_qp.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

#include "utils.h"

#define FIRM 1e-2 /* of the tolerance: DAQP's own, so that a row that it may leave out cannot decide on acceptance */
#define ACTIVE_BELOW (DAQP_ACTIVE | DAQP_LOWER)
#define EVERYTHING (DAQP_UPDATE_M | DAQP_UPDATE_d | DAQP_UPDATE_sense | DAQP_UPDATE_Rinv | DAQP_UPDATE_v)

void daqp_refine_primal(DAQPWorkspace *work);
void ldp2qp_solution(DAQPWorkspace *work);

/* Columns and rows that DAQP is told, and those of its rows that are bounds on x itself. */
static int columns_of(const pcr_qp_shape *shape)
{
    return shape->n - 2 * shape->soft;
}

static int rows_of(const pcr_qp_shape *shape)
{
    return shape->m - 2 * shape->soft;
}

static int bounds_of(const pcr_qp_shape *shape)
{
    return shape->soft ? 0 : columns_of(shape);
}

static double *take(double **from, int count)
{
    double *taken = *from;
    *from += count;
    memset(taken, 0, (size_t)count * sizeof *taken);
    return taken;
}

static int *take_ints(int **from, int count)
{
    int *taken = *from;
    *from += count;
    memset(taken, 0, (size_t)count * sizeof *taken);
    return taken;
}

static void use_settings(DAQPSettings *to, const pcr_qp_settings *from)
{
    memset(to, 0, sizeof *to);
    to->primal_tol = FIRM * from->tolerance;
    to->dual_tol = DAQP_DEFAULT_DUAL_TOL;
    to->zero_tol = DAQP_DEFAULT_ZERO_TOL;
    to->pivot_tol = DAQP_DEFAULT_PIVOT_TOL;
    to->progress_tol = DAQP_DEFAULT_PROG_TOL;
    to->cycle_tol = DAQP_DEFAULT_CYCLE_TOL;
    to->iter_limit = from->max_iterations + 1;
    to->fval_bound = DAQP_INF;
    to->eta_prox = DAQP_DEFAULT_ETA;
    to->rho_soft = DAQP_DEFAULT_RHO_SOFT;
    to->w_soft = DAQP_DEFAULT_W_SOFT;
    to->sing_tol = DAQP_DEFAULT_SING_TOL;
    to->refactor_tol = DAQP_DEFAULT_REFACTOR_TOL;
    to->eq_reduction = DAQP_EQ_REDUCTION_OFF;
}

/* What DAQP is told of each row: soft or not, active or not. */
static void tell_senses(pcr_qp *qp)
{
    for (int i = 0; i < rows_of(qp->shape); i++) {
        const double y = qp->held[i];
        qp->told[i] = qp->sense[i] + (y > 0.0 ? DAQP_ACTIVE : y < 0.0 ? ACTIVE_BELOW : 0);
    }
}

static void forget(pcr_qp *qp)
{
    memset(qp->held, 0, (size_t)rows_of(qp->shape) * sizeof *qp->held);
}

int pcr_qp_setup(pcr_qp *qp, const pcr_qp_shape *shape, const pcr_qp_settings *settings, const int *starts,
                 const int *rows, const double *values, double *doubles, int *ints)
{
    const int n = columns_of(shape), m = rows_of(shape), ms = bounds_of(shape), most = n + shape->soft + 1;
    DAQPWorkspace *work = &qp->work;
    memset(qp, 0, sizeof *qp);
    qp->shape = shape;
    qp->tolerance = settings->tolerance;
    use_settings(&qp->settings, settings);
    work->settings = &qp->settings;

    qp->solution.x = take(&doubles, shape->n);
    qp->solution.y = take(&doubles, shape->m);
    qp->q = take(&doubles, shape->n);
    qp->l = take(&doubles, shape->m);
    qp->u = take(&doubles, shape->m);
    qp->held = take(&doubles, m);
    qp->problem.H = take(&doubles, n * n);
    qp->problem.A = take(&doubles, (m - ms) * n);
    work->lam = take(&doubles, most);
    work->lam_star = take(&doubles, most);
    work->D = take(&doubles, most);
    work->xldl = take(&doubles, most);
    work->zldl = take(&doubles, most);
    work->L = take(&doubles, most * (most + 1) / 2);
    work->u = work->x = take(&doubles, n);
    work->xold = take(&doubles, n);
    work->scaling = take(&doubles, m);
    work->M = take(&doubles, (m - ms) * n);
    work->Mu = take(&doubles, m - ms);
    work->dupper = take(&doubles, m);
    work->dlower = take(&doubles, m);
    work->Rinv = take(&doubles, n * (n + 1) / 2);
    work->v = take(&doubles, n);
    work->WS = take_ints(&ints, most);
    work->prox_mask = take_ints(&ints, n);
    work->sense = take_ints(&ints, m);
    qp->sense = take_ints(&ints, m);
    qp->told = take_ints(&ints, m);
    if (shape->soft) {
        work->rho_ls = take(&doubles, m);
        work->rho_us = take(&doubles, m);
        work->w_ls = take(&doubles, m);
        work->w_us = take(&doubles, m);
        for (int i = 0; i < m; i++) {
            work->rho_ls[i] = work->rho_us[i] = work->w_ls[i] = work->w_us[i] = 1.0;
        }
    }
    for (int i = 0; i < ms; i++) {
        work->scaling[i] = 1.0;
    }
    for (int i = 0; i < n; i++) {
        qp->problem.H[i * n + i] = 1.0;
    }
    for (int j = 0; values != NULL && j < n; j++) {
        for (int e = starts[j]; e < starts[j + 1]; e++) {
            if (rows[e] >= ms) {
                qp->problem.A[(rows[e] - ms) * n + j] = values[e];
            }
        }
    }
    for (int i = 0; i < shape->m; i++) {
        qp->l[i] = -1.0;
        qp->u[i] = 1.0;
    }
    for (int i = m - shape->soft; i < m; i++) {
        qp->sense[i] = DAQP_SOFT;
    }
    work->n = qp->problem.n = n;
    work->m = qp->problem.m = m;
    work->ms = qp->problem.ms = ms;
    work->outer_iter = 1;
    qp->problem.f = qp->q;
    qp->problem.bupper = qp->u;
    qp->problem.blower = qp->l;
    qp->problem.sense = qp->told;
    reset_daqp_workspace(work);
    tell_senses(qp);
    qp->flag = daqp_update_ldp(EVERYTHING, work, &qp->problem);
    return qp->flag == DAQP_EXIT_NONCONVEX ? PCR_LEFT_NOT_CONVEX : 0;
}

void pcr_qp_write(pcr_qp *qp, const double *columns, int stride, int rows)
{
    const int n = columns_of(qp->shape), ms = bounds_of(qp->shape);
    for (int i = ms; i < rows; i++) {
        for (int j = 0; j < n; j++) {
            qp->problem.A[(i - ms) * n + j] = columns[j * stride + i];
        }
    }
}

int pcr_qp_update(pcr_qp *qp, const double *p, int written, const double *q, const double *l, const double *u)
{
    const int n = columns_of(qp->shape), m = rows_of(qp->shape), soft = qp->shape->soft;
    (void)written;
    memcpy(qp->q, q, (size_t)qp->shape->n * sizeof *q);
    memcpy(qp->l, l, (size_t)qp->shape->m * sizeof *l);
    memcpy(qp->u, u, (size_t)qp->shape->m * sizeof *u);
    for (int i = 0; i < soft; i++) {
        qp->work.w_ls[m - soft + i] = q[n + i];
        qp->work.w_us[m - soft + i] = q[n + soft + i];
        qp->sense[m - soft + i] = u[m + i] > 0.0 ? DAQP_SOFT : 0;
    }
    for (int j = 0; p != NULL && j < n; j++) {
        for (int i = 0; i <= j; i++, p++) {
            qp->problem.H[i * n + j] = qp->problem.H[j * n + i] = *p;
        }
    }
    tell_senses(qp);
    /* Everything, always: what is left out, DAQP takes from before. */
    int mask = DAQP_UPDATE_v | DAQP_UPDATE_d | DAQP_UPDATE_sense;
    mask |= m > bounds_of(qp->shape) ? DAQP_UPDATE_M : 0;
    mask |= p != NULL ? DAQP_UPDATE_Rinv : 0;
    qp->flag = daqp_update_ldp(mask, &qp->work, &qp->problem);
    if (qp->flag == 0 || qp->flag == DAQP_EXIT_INFEASIBLE || qp->flag == DAQP_EXIT_OVERDETERMINED_INITIAL) {
        return 0;
    }
    return PCR_LEFT_NOT_CONVEX;
}

void pcr_qp_warm_start(pcr_qp *qp, const double *x, const double *y)
{
    (void)x;
    if (y == NULL) {
        return;
    }
    memcpy(qp->held, y, (size_t)rows_of(qp->shape) * sizeof *y);
    tell_senses(qp);
    qp->flag = daqp_update_ldp(DAQP_UPDATE_sense, &qp->work, &qp->problem);
}

/* Multipliers of all rows. */
static void write_multipliers(const DAQPWorkspace *work, double *y)
{
    memset(y, 0, (size_t)work->m * sizeof *y);
    for (int k = 0; k < work->n_active; k++) {
        const int i = work->WS[k];
        const double found = work->lam_star[k];
        const int firm = !DAQP_IS_IMMUTABLE(i) && !DAQP_IS_SOFT(i);
        y[i] = firm && (DAQP_IS_LOWER(i) ? found > 0.0 : found < 0.0) ? 0.0 : found;
    }
}

/* Slacks and their multipliers, from the rest. */
static void write_slacks(pcr_qp *qp)
{
    const int n = columns_of(qp->shape), m = rows_of(qp->shape), soft = qp->shape->soft;
    double *x = qp->solution.x, *y = qp->solution.y;
    for (int i = 0; i < soft; i++) {
        const int row = m - soft + i, gives = qp->sense[row] == DAQP_SOFT;
        double value = 0.0;
        for (int j = 0; j < n; j++) {
            value += qp->problem.A[row * n + j] * x[j];
        }
        const double under = qp->l[row] - value, over = value - qp->u[row];
        x[n + i] = gives && under > 0.0 ? under : 0.0;
        x[n + soft + i] = gives && over > 0.0 ? over : 0.0;
        y[m + i] = -(x[n + i] + qp->q[n + i] + y[row]);
        y[m + soft + i] = -(x[n + soft + i] + qp->q[n + soft + i] - y[row]);
    }
}

int pcr_qp_solve(pcr_qp *qp, int most, int *iterations)
{
    DAQPWorkspace *work = &qp->work;
    int flag = qp->flag;
    *iterations = 0;
    if (flag == 0) {
        qp->settings.iter_limit = most + 1;
        flag = daqp_ldp(work);
        if (flag > 0) {
            ldp2qp_solution(work);
            daqp_refine_primal(work);
            if ((work->state & DAQP_STATE_NOISE_FLOOR) && daqp_violates_hard(work)) {
                flag = DAQP_EXIT_OPTIMAL_INEXACT;
            }
        }
        *iterations = work->iterations < most ? work->iterations : most;
    }
    if (flag == DAQP_EXIT_OPTIMAL || flag == DAQP_EXIT_SOFT_OPTIMAL) {
        memcpy(qp->solution.x, work->x, (size_t)work->n * sizeof *work->x);
        write_multipliers(work, qp->solution.y);
        write_slacks(qp);
        return PCR_LEFT_SOLVED;
    }
    forget(qp);
    switch (flag) {
    case DAQP_EXIT_INFEASIBLE:
    case DAQP_EXIT_OVERDETERMINED_INITIAL:
        return PCR_LEFT_INFEASIBLE;
    case DAQP_EXIT_ITERLIMIT:
        return PCR_LEFT_LIMIT;
    default:
        return PCR_LEFT_INACCURATE;
    }
}

static double larger(double a, double b)
{
    return a > b ? a : b;
}

/* Whether residuals are within the tolerance relative to what they are differences of, as OSQP judges. */
static int accepted(const pcr_qp *qp, double primal, double dual)
{
    const int n = columns_of(qp->shape), m = rows_of(qp->shape), ms = bounds_of(qp->shape), soft = qp->shape->soft;
    const double *x = qp->solution.x, *y = qp->solution.y, *a = qp->problem.A;
    double greatest = 0.0, furthest = 0.0;
    for (int j = 0; j < qp->shape->n; j++) {
        double tension = j < ms ? y[j] : 0.0;
        for (int i = ms; i < m && j < n; i++) {
            tension += a[(i - ms) * n + j] * y[i];
        }
        if (j >= n) {
            const double tied = y[m - soft + (j - n) % soft];
            tension = (j < n + soft ? tied : -tied) + y[m + j - n];
        }
        greatest = larger(greatest, larger(fabs(qp->q[j]), larger(fabs(tension), fabs(qp->q[j] + tension))));
    }
    for (int i = 0; i < qp->shape->m; i++) {
        double value = i < ms ? x[i] : i >= m ? x[n + i - m] : 0.0;
        for (int j = 0; j < n && i >= ms && i < m; j++) {
            value += a[(i - ms) * n + j] * x[j];
        }
        if (i >= m - soft && i < m) {
            value += x[n + i - (m - soft)] - x[n + soft + i - (m - soft)];
        }
        furthest = larger(furthest, fabs(value));
    }
    return primal <= qp->tolerance * (1.0 + furthest) && dual <= qp->tolerance * (1.0 + greatest);
}

int pcr_qp_judge(pcr_qp *qp, double primal, double dual)
{
    /* So written that NaN is not accepted. */
    if (!(primal <= qp->tolerance && dual <= qp->tolerance) && !accepted(qp, primal, dual)) {
        forget(qp);
        return PCR_LEFT_INACCURATE;
    }
    memcpy(qp->held, qp->solution.y, (size_t)rows_of(qp->shape) * sizeof *qp->held);
    return 0;
}

double pcr_qp_memory(const pcr_qp *qp)
{
    (void)qp;
    return 0.0;
}

void pcr_qp_resume(pcr_qp *qp, const double *x, const double *y, int solved, double memory)
{
    (void)memory;
    memcpy(qp->solution.x, x, (size_t)qp->shape->n * sizeof *x);
    memcpy(qp->solution.y, y, (size_t)qp->shape->m * sizeof *y);
    if (solved) {
        memcpy(qp->held, y, (size_t)rows_of(qp->shape) * sizeof *y);
    }
}

void pcr_qp_restore(pcr_qp *qp, const pcr_qp *saved)
{
    /* All of it follows from the data and from the multipliers that are held. */
    qp->settings = saved->settings;
    tell_senses(qp);
    reset_daqp_workspace(&qp->work);
    qp->flag = daqp_update_ldp(EVERYTHING, &qp->work, &qp->problem);
}
