/* OSQP in memory that its owner provides: nothing is allocated, and two solvers share nothing. */
#ifndef PCR_QP_H
#define PCR_QP_H

#include "algebra_impl.h"
#include "osqp.h"
#include "qdldl_interface.h"
#include "types.h"

#ifdef __cplusplus
extern "C" {
#endif

#define PCR_INFINITY OSQP_INFTY

/* How a QP was left; the order is that of pcr_qp_status in pcr.h. */
enum {
    PCR_LEFT_SOLVED,
    PCR_LEFT_INACCURATE,
    PCR_LEFT_INFEASIBLE,
    PCR_LEFT_UNBOUNDED,
    PCR_LEFT_LIMIT,
    PCR_LEFT_NOT_CONVEX,
    PCR_LEFT_CROSSED
};

/* Sizes and pattern of one QP, min 1/2 x'Px + q'x subject to l <= Ax <= u; all constant. */
typedef struct {
    int n, m;
    int identity;                 /* P is the identity and stays it; else its whole upper triangle is stored */
    int entries_p, entries_a;     /* stored entries of P and A */
    int entries_k, entries_l;     /* of the KKT matrix, and of its factor */
    const unsigned short *order;  /* elimination order of the KKT matrix (n + m), as OSQP's ordering found it */
} pcr_qp_shape;

/* Settings of OSQP that are not its defaults. */
typedef struct {
    double tolerance;
    int max_iterations;
} pcr_qp_settings;

typedef struct {
    OSQPSolver solver;
    OSQPSettings settings;
    OSQPSolution solution;
    OSQPInfo info;
    OSQPWorkspace work;
    OSQPData data;
    OSQPScaling scaling;
    OSQPMatrix p, a;
    OSQPCscMatrix p_csc, a_csc, kkt, factor;
    qdldl_solver linear;
    OSQPVectori constraint_type;
    OSQPVectorf vectors[28];
    const pcr_qp_shape *shape;
    double first_rho;
} pcr_qp;

/* Build the workspace in `doubles` and `ints`, whose sizes pcr_config.h has; A's pattern is in `starts` (n + 1) and
   `rows`, which must live as long as it, its first values in `values` (NULL: ones). Returns 0, or
   PCR_LEFT_NOT_CONVEX. */
int pcr_qp_setup(pcr_qp *qp, const pcr_qp_shape *shape, const pcr_qp_settings *settings, const int *starts,
                 const int *rows, const double *values, double *doubles, int *ints);

/* Write A's first `rows` rows without slacks, from columns that lie `stride` apart. */
void pcr_qp_write(pcr_qp *qp, const double *columns, int stride, int rows);

/* Replace the data; NULL for P keeps it, and `written` says that A was. Returns 0, or PCR_LEFT_NOT_CONVEX: then set it
   up anew. */
int pcr_qp_update(pcr_qp *qp, const double *p, int written, const double *q, const double *l, const double *u);

/* Start the next solution from x and multipliers y; NULL for y keeps the last ones. */
void pcr_qp_warm_start(pcr_qp *qp, const double *x, const double *y);

/* Solve in at most `most` iterations; x and y are in qp->solution if 0 is returned. */
int pcr_qp_solve(pcr_qp *qp, int most, int *iterations);

/* Accept a solution by its residuals: OSQP has judged itself. */
int pcr_qp_judge(pcr_qp *qp, double primal, double dual);

/* What a solver remembers besides its solution; and go on from a solution and that. */
double pcr_qp_memory(const pcr_qp *qp);
void pcr_qp_resume(pcr_qp *qp, const double *x, const double *y, int solved, double memory);

/* Be what `saved` was, a copy of a solver of the same shape whose pointers mean nothing any more: qp was set up anew, and
   the doubles and ints of that solver were copied into its own. */
void pcr_qp_restore(pcr_qp *qp, const pcr_qp *saved);

#ifdef __cplusplus
}
#endif

#endif
