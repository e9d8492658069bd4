/* OSQP's set-up without an allocator: what osqp_setup does, in memory that is handed in. */
#include "pcr_qp.h"

#include <stddef.h>
#include <string.h>

#include "auxil.h"
#include "qdldl.h"
#include "scaling.h"

typedef struct {
    double *doubles;
    int *ints;
} pool;

static double *take_doubles(pool *from, int count)
{
    double *taken = from->doubles;
    from->doubles += count;
    memset(taken, 0, (size_t)count * sizeof *taken);
    return taken;
}

static int *take_ints(pool *from, int count)
{
    int *taken = from->ints;
    from->ints += count;
    memset(taken, 0, (size_t)count * sizeof *taken);
    return taken;
}

static OSQPVectorf *vector(pcr_qp *qp, int *used, pool *from, int length)
{
    OSQPVectorf *made = &qp->vectors[(*used)++];
    made->values = take_doubles(from, length);
    made->length = length;
    return made;
}

static OSQPVectorf *view(pcr_qp *qp, int *used, OSQPVectorf *of, int first, int length)
{
    OSQPVectorf *made = &qp->vectors[(*used)++];
    made->values = of->values + first;
    made->length = length;
    return made;
}

static void shape_matrix(OSQPCscMatrix *matrix, int m, int n, int entries, pool *from)
{
    matrix->m = m;
    matrix->n = n;
    matrix->p = take_ints(from, n + 1);
    matrix->i = take_ints(from, entries);
    matrix->x = take_doubles(from, entries);
    matrix->nzmax = entries;
    matrix->nz = -1;
    matrix->owned = 0;
}

static void use_settings(OSQPSettings *to, const pcr_qp_shape *shape, const pcr_qp_settings *from)
{
    osqp_set_default_settings(to);
    to->verbose = 0;
    to->eps_abs = to->eps_rel = from->tolerance;
    to->max_iter = from->max_iterations;
    to->adaptive_rho = OSQP_ADAPTIVE_RHO_UPDATE_ITERATIONS;
    to->adaptive_rho_interval = 25;
    to->adaptive_rho_tolerance = 2.0;
    to->rho = shape->identity ? 1.0 : 0.1;
    to->scaling = shape->identity ? 0 : 2;
    to->check_termination = 5;
    to->polishing = 0;
}

/* The entries of A row by row: `starts` (m + 1), and of each entry its place in A and its column. */
static void list_rows(const OSQPCscMatrix *a, int *starts, int *entries, int *columns)
{
    for (int e = 0; e < a->nzmax; e++) {
        starts[a->i[e] + 1]++;
    }
    for (int i = 0; i < a->m; i++) {
        starts[i + 1] += starts[i];
    }
    for (int j = 0; j < a->n; j++) {
        for (int e = a->p[j]; e < a->p[j + 1]; e++) {
            const int at = starts[a->i[e]]++;
            entries[at] = e;
            columns[at] = j;
        }
    }
    for (int i = a->m; i > 0; i--) {
        starts[i] = starts[i - 1];
    }
    starts[0] = 0;
}

/* One entry of the KKT matrix, in its elimination order: counted first, and written then. Returns where it went. */
static int put(OSQPCscMatrix *kkt, int *next, int row, int column, double value, int writing)
{
    const int at = next[row > column ? row : column]++;
    if (writing) {
        kkt->i[at] = row < column ? row : column;
        kkt->x[at] = value;
    }
    return at;
}

/* The KKT matrix [P + sigma I, A'; A, -1/rho] in its elimination order, and where each entry of P, A and rho went. */
static void assemble(pcr_qp *qp, pool *from)
{
    qdldl_solver *s = &qp->linear;
    const int n = qp->shape->n, m = qp->shape->m, size = n + m;
    const OSQPCscMatrix *p = &qp->p_csc, *a = &qp->a_csc;
    int *place = take_ints(from, size), *next = take_ints(from, size), *starts = take_ints(from, m + 1);
    int *entries = take_ints(from, a->nzmax), *columns = take_ints(from, a->nzmax);
    list_rows(a, starts, entries, columns);
    for (int k = 0; k < size; k++) {
        s->P[k] = qp->shape->order[k];
        place[s->P[k]] = k;
    }
    for (int writing = 0; writing < 2; writing++) {
        for (int j = 0; j < n; j++) {
            for (int e = p->p[j]; e < p->p[j + 1]; e++) {
                const double value = p->x[e] + (p->i[e] == j ? s->sigma : 0.0);
                s->PtoKKT[e] = put(&qp->kkt, next, place[p->i[e]], place[j], value, writing);
            }
        }
        for (int i = 0; i < m; i++) {
            for (int e = starts[i]; e < starts[i + 1]; e++) {
                const double value = a->x[entries[e]];
                s->AtoKKT[entries[e]] = put(&qp->kkt, next, place[columns[e]], place[n + i], value, writing);
            }
            s->rhotoKKT[i] = put(&qp->kkt, next, place[n + i], place[n + i], -s->rho_inv_vec[i], writing);
        }
        if (!writing) {
            int before = 0;
            for (int k = 0; k < size; k++) {
                const int count = next[k];
                qp->kkt.p[k] = next[k] = before;
                before += count;
            }
            qp->kkt.p[size] = before;
        }
    }
}

int pcr_qp_setup(pcr_qp *qp, const pcr_qp_shape *shape, const pcr_qp_settings *settings, const int *starts,
                 const int *rows, const double *values, double *doubles, int *ints)
{
    pool from = {NULL, NULL};
    from.doubles = doubles;
    from.ints = ints;
    const int n = shape->n, m = shape->m, size = n + m;
    OSQPWorkspace *work = &qp->work;
    int used = 0;

    memset(qp, 0, sizeof *qp);
    qp->shape = shape;
    use_settings(&qp->settings, shape, settings);
    qp->first_rho = qp->settings.rho;
    qp->solver.settings = &qp->settings;
    qp->solver.solution = &qp->solution;
    qp->solver.info = &qp->info;
    qp->solver.work = work;
    work->data = &qp->data;

    shape_matrix(&qp->p_csc, n, n, shape->entries_p, &from);
    for (int j = 0, e = 0; j < n; j++) {
        for (int i = shape->identity ? j : 0; i <= j; i++, e++) {
            qp->p_csc.i[e] = i;
            qp->p_csc.x[e] = i == j ? 1.0 : 0.0;
        }
        qp->p_csc.p[j + 1] = e;
    }
    qp->a_csc.m = m;
    qp->a_csc.n = n;
    qp->a_csc.p = (int *)starts; /* OSQP writes into no pattern */
    qp->a_csc.i = (int *)rows;
    qp->a_csc.x = take_doubles(&from, shape->entries_a);
    qp->a_csc.nzmax = shape->entries_a;
    qp->a_csc.nz = -1;
    for (int e = 0; e < shape->entries_a; e++) {
        qp->a_csc.x[e] = values == NULL ? 1.0 : values[e];
    }
    qp->p.csc = &qp->p_csc;
    qp->p.symmetry = TRIU;
    qp->a.csc = &qp->a_csc;
    qp->a.symmetry = NONE;
    qp->data.n = n;
    qp->data.m = m;
    qp->data.P = &qp->p;
    qp->data.A = &qp->a;
    qp->data.q = vector(qp, &used, &from, n);
    qp->data.l = vector(qp, &used, &from, m);
    qp->data.u = vector(qp, &used, &from, m);
    for (int i = 0; i < m; i++) {
        qp->data.l->values[i] = -1.0;
        qp->data.u->values[i] = 1.0;
    }

    work->rho_vec = vector(qp, &used, &from, m);
    work->rho_inv_vec = vector(qp, &used, &from, m);
    qp->constraint_type.values = take_ints(&from, m);
    qp->constraint_type.length = m;
    work->constr_type = &qp->constraint_type;
    work->x = vector(qp, &used, &from, n);
    work->z = vector(qp, &used, &from, m);
    work->y = vector(qp, &used, &from, m);
    work->xz_tilde = vector(qp, &used, &from, size);
    work->xtilde_view = view(qp, &used, work->xz_tilde, 0, n);
    work->ztilde_view = view(qp, &used, work->xz_tilde, n, m);
    work->x_prev = vector(qp, &used, &from, n);
    work->z_prev = vector(qp, &used, &from, m);
    work->Ax = vector(qp, &used, &from, m);
    work->Px = vector(qp, &used, &from, n);
    work->Aty = vector(qp, &used, &from, n);
    work->delta_y = vector(qp, &used, &from, m);
    work->Atdelta_y = vector(qp, &used, &from, n);
    work->delta_x = vector(qp, &used, &from, n);
    work->Pdelta_x = vector(qp, &used, &from, n);
    work->Adelta_x = vector(qp, &used, &from, m);
    if (qp->settings.scaling) {
        work->scaling = &qp->scaling;
        qp->scaling.D = vector(qp, &used, &from, n);
        qp->scaling.Dinv = vector(qp, &used, &from, n);
        qp->scaling.E = vector(qp, &used, &from, m);
        qp->scaling.Einv = vector(qp, &used, &from, m);
        work->D_temp = vector(qp, &used, &from, n);
        work->D_temp_A = vector(qp, &used, &from, n);
        work->E_temp = vector(qp, &used, &from, m);
        scale_data(&qp->solver);
    }
    set_rho_vec(&qp->solver);

    qp->solution.x = take_doubles(&from, n);
    qp->solution.y = take_doubles(&from, m);
    qp->solution.prim_inf_cert = take_doubles(&from, m);
    qp->solution.dual_inf_cert = take_doubles(&from, n);
    qp->info.obj_val = qp->info.prim_res = qp->info.dual_res = qp->info.rel_kkt_error = OSQP_INFTY;
    qp->info.rho_estimate = qp->settings.rho;
    work->last_rel_kkt = OSQP_INFTY;

    qdldl_solver *s = &qp->linear;
    s->type = OSQP_DIRECT_SOLVER;
    s->name = &name_qdldl;
    s->solve = &solve_linsys_qdldl;
    s->update_settings = &update_settings_linsys_solver_qdldl;
    s->warm_start = &warm_start_linsys_solver_qdldl;
    s->update_matrices = &update_linsys_solver_matrices_qdldl;
    s->update_rho_vec = &update_linsys_solver_rho_vec_qdldl;
    s->nthreads = 1;
    s->n = n;
    s->m = m;
    s->sigma = qp->settings.sigma;
    s->rho_inv = 1.0 / qp->settings.rho;
    shape_matrix(&qp->factor, size, size, shape->entries_l, &from);
    shape_matrix(&qp->kkt, size, size, shape->entries_k, &from);
    s->L = &qp->factor;
    s->KKT = &qp->kkt;
    s->D = take_doubles(&from, size);
    s->Dinv = take_doubles(&from, size);
    s->bp = take_doubles(&from, size);
    s->sol = take_doubles(&from, size);
    s->fwork = take_doubles(&from, size);
    s->rho_inv_vec = take_doubles(&from, m);
    s->P = take_ints(&from, size);
    s->etree = take_ints(&from, size);
    s->Lnz = take_ints(&from, size);
    s->iwork = take_ints(&from, 3 * size);
    s->bwork = take_ints(&from, size);
    s->PtoKKT = take_ints(&from, shape->entries_p);
    s->AtoKKT = take_ints(&from, shape->entries_a);
    s->rhotoKKT = take_ints(&from, m);
    for (int i = 0; i < m; i++) {
        s->rho_inv_vec[i] = 1.0 / work->rho_vec->values[i];
    }
    assemble(qp, &from);
    work->linsys_solver = (LinSysSolver *)s;
    const int entries = QDLDL_etree(size, qp->kkt.p, qp->kkt.i, s->iwork, s->Lnz, s->etree);
    if (entries < 0 || entries > shape->entries_l) {
        return PCR_LEFT_NOT_CONVEX; /* another pattern than the one that the sizes are of */
    }
    const int positive = QDLDL_factor(size, qp->kkt.p, qp->kkt.i, qp->kkt.x, s->L->p, s->L->i, s->L->x, s->D, s->Dinv,
                                      s->Lnz, s->etree, s->bwork, s->iwork, s->fwork);
    return positive == n ? 0 : PCR_LEFT_NOT_CONVEX;
}

void pcr_qp_write(pcr_qp *qp, const double *columns, int stride, int rows)
{
    const int slacks = (qp->shape->m - rows), size = qp->shape->n - slacks;
    double *entries = qp->a_csc.x; /* where they belong; OSQP copies them onto themselves */
    for (int j = 0; j < size; j++) {
        memcpy(entries + j * rows, columns + j * stride, (size_t)rows * sizeof *columns);
    }
    for (int j = 0, e = size * rows; j < slacks; j++) {
        entries[e++] = 2 * j < slacks ? 1.0 : -1.0;
        entries[e++] = 1.0;
    }
}

int pcr_qp_update(pcr_qp *qp, const double *p, int written, const double *q, const double *l, const double *u)
{
    const double *a = written ? qp->a_csc.x : NULL;
    if ((p != NULL || a != NULL) && osqp_update_data_mat(&qp->solver, p, NULL, 0, a, NULL, 0)) {
        return PCR_LEFT_NOT_CONVEX;
    }
    return osqp_update_data_vec(&qp->solver, q, l, u) ? PCR_LEFT_CROSSED : 0;
}

void pcr_qp_warm_start(pcr_qp *qp, const double *x, const double *y)
{
    osqp_warm_start(&qp->solver, x, y);
}

int pcr_qp_solve(pcr_qp *qp, int most, int *iterations)
{
    qp->settings.max_iter = most;
    osqp_solve(&qp->solver);
    *iterations = qp->info.iter;
    if (qp->info.status_val == OSQP_SOLVED) {
        return PCR_LEFT_SOLVED;
    }
    /* An unsolved problem's iterate and step size must not start the next one. */
    osqp_cold_start(&qp->solver);
    osqp_update_rho(&qp->solver, qp->first_rho);
    switch (qp->info.status_val) {
    case OSQP_PRIMAL_INFEASIBLE:
    case OSQP_PRIMAL_INFEASIBLE_INACCURATE:
        return PCR_LEFT_INFEASIBLE;
    case OSQP_DUAL_INFEASIBLE:
    case OSQP_DUAL_INFEASIBLE_INACCURATE:
        return PCR_LEFT_UNBOUNDED;
    case OSQP_MAX_ITER_REACHED:
        return PCR_LEFT_LIMIT;
    case OSQP_NON_CVX:
        return PCR_LEFT_NOT_CONVEX;
    default:
        return PCR_LEFT_INACCURATE;
    }
}

int pcr_qp_judge(pcr_qp *qp, double primal, double dual)
{
    (void)qp, (void)primal, (void)dual;
    return 0;
}

double pcr_qp_memory(const pcr_qp *qp)
{
    return qp->settings.rho;
}

void pcr_qp_resume(pcr_qp *qp, const double *x, const double *y, int solved, double memory)
{
    /* The iterates need not be kept: every solution starts from the last one, or, after a failure, from zero. */
    (void)solved;
    memcpy(qp->solution.x, x, (size_t)qp->shape->n * sizeof *x);
    memcpy(qp->solution.y, y, (size_t)qp->shape->m * sizeof *y);
    osqp_update_rho(&qp->solver, memory);
}

/* The vector in the place of one of `saved`; OSQP exchanges vectors by their pointers. */
static OSQPVectorf *counterpart(pcr_qp *qp, const pcr_qp *saved, const OSQPVectorf *of)
{
    return qp->work.y + (of - saved->work.y);
}

void pcr_qp_restore(pcr_qp *qp, const pcr_qp *saved)
{
    OSQPWorkspace *to = &qp->work;
    const OSQPWorkspace *from = &saved->work;
    to->x = counterpart(qp, saved, from->x);
    to->x_prev = counterpart(qp, saved, from->x_prev);
    to->z = counterpart(qp, saved, from->z);
    to->z_prev = counterpart(qp, saved, from->z_prev);
    to->delta_y = counterpart(qp, saved, from->delta_y);
    qp->data.l = counterpart(qp, saved, saved->data.l);
    qp->data.u = counterpart(qp, saved, saved->data.u);
    to->scaled_prim_res = from->scaled_prim_res;
    to->scaled_dual_res = from->scaled_dual_res;
    to->rho_inv = from->rho_inv;
    to->rho_updated = from->rho_updated;
    to->last_rel_kkt = from->last_rel_kkt;
    qp->settings = saved->settings;
    qp->info = saved->info;
    qp->scaling.c = saved->scaling.c;
    qp->scaling.cinv = saved->scaling.cinv;
    qp->linear.sigma = saved->linear.sigma;
    qp->linear.rho_inv = saved->linear.rho_inv;
    qp->first_rho = saved->first_rho;
}
