/* A watch on the limits of one pose: what the files share that put their rows together. */
#ifndef PCR_WATCH_H
#define PCR_WATCH_H

#include "pcr_parts.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Share of a strain limit from which it is watched: a controller looks a horizon ahead. */
#define PCR_STRAIN_WATCHED 0.8
#define PCR_MARGIN_WATCHED 0.25 /* of a rod's margin */
#define PCR_LEAST_CRITICAL_LOAD 5.7659

typedef struct {
    pcr_controller *controller;
    pcr_pose_limits *limits;
    const double *x;
    double *record;       /* of the rods at x */
    const double *result; /* F, K, G of them */
    pcr_room room;
} pcr_watch;

/* Numbers of rod i: stiffness, length, base x, base y, ... */
const double *pcr_rod(const pcr_watch *w, int i);

/* A new row of a kind, one unit of which is `scale`; returns its number. */
int pcr_row(pcr_watch *w, int kind, double scale);

/* The row times the state. */
double pcr_times_state(const pcr_watch *w, int at);

/* Add derivatives by the pose of rod i [x/L, y/L, angle] to those by the state. */
void pcr_by_state(const pcr_watch *w, int at, int i, const double *by_pose);

/* pcr_margin.c: margin of each rod to its critical load. */
void pcr_rod_margins(pcr_watch *w, int kind);

/* pcr_strain.c: largest strain of each rod. */
void pcr_strain(pcr_watch *w, int kind);

#ifdef __cplusplus
}
#endif

#endif
