/* DAQP in memory that its owner provides: nothing is allocated, and two solvers share nothing. */
#ifndef PCR_QP_H
#define PCR_QP_H

#include "pcr_config.h"
#if PCR_SINGLE
#define DAQP_SINGLE_PRECISION
#endif
#include "types.h"

#ifdef __cplusplus
extern "C" {
#endif

#define PCR_INFINITY 1e30

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

/* Sizes of one QP, min 1/2 x'Px + q'x subject to l <= Ax <= u. Where P is the identity the last 2 `soft` columns are
   slacks of the last `soft` rows before their own, as in pcr_limited.c; DAQP is told the rows without them. */
typedef struct {
    int n, m;
    int identity; /* P is the identity and stays it */
    int soft;
} pcr_qp_shape;

typedef struct {
    double tolerance;
    int max_iterations;
} pcr_qp_settings;

typedef struct {
    DAQPWorkspace work;
    DAQPProblem problem;
    DAQPSettings settings;
    struct {
        double *x, *y;
    } solution;
    const pcr_qp_shape *shape;
    double tolerance;
    double *q, *l, *u;  /* as they were handed over, of all rows and columns */
    double *held;       /* multipliers of the rows that are active in the next solution's start */
    int *sense;         /* which rows are soft now */
    int *told;          /* the same, with those that are active */
    int flag;           /* of the last update */
} pcr_qp;

/* Build the workspace in `doubles` and `ints`, whose sizes pcr_config.h has. A begins with the identity and goes on with
   the rows in `starts` (n + 1) and `rows` with their `values`; NULL: it comes by pcr_qp_write. Returns 0, or
   PCR_LEFT_NOT_CONVEX. */
int pcr_qp_setup(pcr_qp *qp, const pcr_qp_shape *shape, const pcr_qp_settings *settings, const int *starts,
                 const int *rows, const double *values, double *doubles, int *ints);

/* Write A's first `rows` rows without slacks, from columns that lie `stride` apart. */
void pcr_qp_write(pcr_qp *qp, const double *columns, int stride, int rows);

/* Replace the data; NULL for P keeps it, and `written` says that A was. Returns 0, or PCR_LEFT_NOT_CONVEX: then set it
   up anew. */
int pcr_qp_update(pcr_qp *qp, const double *p, int written, const double *q, const double *l, const double *u);

/* Start the next solution from multipliers y; NULL keeps the last ones. An x tells an active set nothing more. */
void pcr_qp_warm_start(pcr_qp *qp, const double *x, const double *y);

/* Solve in at most `most` iterations; x and y are in qp->solution if 0 is returned. */
int pcr_qp_solve(pcr_qp *qp, int most, int *iterations);

/* Accept a solution by its residuals: 0, or PCR_LEFT_INACCURATE. */
int pcr_qp_judge(pcr_qp *qp, double primal, double dual);

/* What a solver remembers besides its solution; and go on from a solution and that, or, unless it was `solved`, afresh. */
double pcr_qp_memory(const pcr_qp *qp);
void pcr_qp_resume(pcr_qp *qp, const double *x, const double *y, int solved, double memory);

/* Be what `saved` was, a copy of a solver of the same shape whose pointers mean nothing any more: qp was set up anew, and
   the doubles and ints of that solver were copied into its own. */
void pcr_qp_restore(pcr_qp *qp, const pcr_qp *saved);

#ifdef __cplusplus
}
#endif

#endif
