/* The scene as Python ran it: what a test of this code is held against. */
#ifndef PCR_VECTORS_H
#define PCR_VECTORS_H

#include "pcr.h"

extern const double pcr_vector_noise[PCR_PERIODS][2];        /* that was added to the measured tip [m] */
extern const unsigned char pcr_vector_seen[PCR_PERIODS];      /* whether a tip came */
extern const double pcr_vector_measured[PCR_PERIODS][PCR_STATES]; /* [p, v, q] */
extern const double pcr_vector_u[PCR_PERIODS][PCR_N];        /* rates that were decided [rad/s] */
extern const unsigned char pcr_vector_rung[PCR_PERIODS];     /* pcr_rung */
extern const unsigned short pcr_vector_iterations[PCR_PERIODS];
extern const double pcr_vector_x[PCR_PERIODS][PCR_STATES];   /* state of the plant at the end of each period */
extern const double pcr_vector_wanted[PCR_PERIODS * PCR_STEPS_A_PERIOD + 1][2]; /* tip positions asked for [m] */
extern const double pcr_vector_payload[PCR_PERIODS * PCR_STEPS_A_PERIOD]; /* that the tip carries [kg] */
extern const double pcr_vector_force[2];                     /* on the tip [N] */
extern const double pcr_vector_rms_mm;                       /* error of the tip over the whole run */

#endif
