/* The QP with everything that may be softened: angle limits, and the limits of poses that are near. */
#ifndef PCR_LIMITED_H
#define PCR_LIMITED_H

#include "pcr_config.h"
#include "pcr_qp.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Limits of a pose that are near, linear in the state: lower <= C x <= upper. */
typedef struct {
    int kinds;                                /* bit k: rows of kind k, in the order of the kinds */
    int count;                                /* rows; 0: no limit is near */
    int kind[PCR_POSE_ROWS + 1];              /* of each row */
    double c[PCR_POSE_ROWS + 1][PCR_STATES];  /* one more than there can be: an array has one at least */
    double lower[PCR_POSE_ROWS + 1], upper[PCR_POSE_ROWS + 1];
    double scale[PCR_POSE_ROWS + 1];          /* what one unit of a row is */
} pcr_pose_limits;

/* What is kept of the solver of one combination of kinds while another one is at work; its last slacks and multipliers
   are in pcr_limited.last. */
typedef struct {
    int used, solved;
    double memory;
} pcr_limited_state;

typedef struct {
    pcr_qp qp;
    int kinds;           /* of the solver that is at work; -1: none */
    double penalty;
    double doubles[PCR_LIMITED_DOUBLES];
    int ints[PCR_LIMITED_INTS];
    int starts[PCR_LIMITED_N + 1], rows[PCR_LIMITED_A];
    double factor[PCR_INPUTS][PCR_INPUTS];    /* L, lower triangular, with P = L L' */
    double stacked[PCR_INPUTS][PCR_LIMITED_ROWS];
    double length[PCR_LIMITED_ROWS];
    double q[PCR_LIMITED_N], l[PCR_LIMITED_M], u[PCR_LIMITED_M];
    pcr_limited_state kept[1 << PCR_POSE_KINDS];
    double last[PCR_LIMITED_LAST];
} pcr_limited;

typedef struct {
    int left, iterations;
    double inputs[PCR_INPUTS];
    double pull[3 + PCR_POSE_KINDS];   /* largest multiplier of rates, changes of rate, angles and each kind */
    double slack[1 + PCR_POSE_KINDS];  /* by how much angles [rad] and each kind had to give, in their own units */
    double primal_residual, dual_residual;
} pcr_limited_answer;

#define PCR_MOTOR_ROWS (3 * PCR_INPUTS)

/* pcr_stack.c: L from the upper triangle of P column by column, which is the lower one row by row; 0 if P is positive
   definite. Then rows of rates, changes of rate and angles; those of poses, over dt, with their bounds. */
int pcr_factorise(double factor[PCR_INPUTS][PCR_INPUTS], const double *p);
void pcr_stack(pcr_limited *limited, const double *models, const double *x, double dt, const pcr_pose_limits *limits,
               double *low, double *high);

/* Forget everything. */
void pcr_limited_reset(pcr_limited *limited, double penalty);

/* Be a copy of `saved`, wherever that was. */
void pcr_limited_restore(pcr_limited *limited, const pcr_limited *saved);

/* Solve in at most `most` iterations, from the inputs `warm` (NULL: from where the last solution was). P is the upper
   triangle, column by column; models, x and dt predict what the limits of poses are about. */
void pcr_limited_solve(pcr_limited *limited, const double *p, const double *q, const double *l, const double *u,
                       const double *models, const double *x, double dt, const pcr_pose_limits *limits,
                       int soft_angles, const double *warm, int most, pcr_limited_answer *answer);

#ifdef __cplusplus
}
#endif

#endif
