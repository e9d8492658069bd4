/* Largest strain of each rod, linear in the state, where it comes near what the rod bears. */
#include <math.h>
#include <string.h>

#include "pcr_graphs.h"
#include "pcr_watch.h"

#define BETWEEN_NODES 0.9 /* of the largest strain that one of the nodes of a rod has, at least */

#if !PCR_WATCH_SHOT
/* K(k) of a plain rod with this tip angle, from k' = sin(tip_angle / 2), by the arithmetic-geometric mean. */
static double quarter_period(double log_tip_angle)
{
    if (log_tip_angle < PCR_LOG_TAUT) {
        return log(8.0) - log_tip_angle;
    }
    double a = 1.0, b = sin(exp(log_tip_angle) / 2.0);
    for (int i = 0; i < 40 && fabs(a - b) > 1e-16 * a; i++) {
        const double mean = 0.5 * (a + b);
        b = sqrt(a * b);
        a = mean;
    }
    return 1.57079632679489661923 / a;
}

/* Share of its limit that rod i bears, and the derivatives of that by the pose. In closed form the largest moment is at
   the base, or it is 2 lambda k EI/L within the rod. */
static double share_of(pcr_watch *w, int i, double limit, const double *physics, double coarse, double *slopes)
{
    const double *unknowns = w->record + PCR_UNKNOWNS + PCR_WATCH_WIDTH * i;
    const double *tangent = w->record + PCR_TANGENTS(PCR_WATCH_WIDTH) + 3 * PCR_WATCH_WIDTH * i;
    const double unit = pcr_thickness[i] / limit, load = unknowns[1];
    (void)physics;
    (void)coarse;
    if (load > quarter_period(unknowns[0])) {
        const double half = exp(unknowns[0]) / 2.0, k = cos(half), slope = -half * sin(half);
        for (int j = 0; j < 3; j++) {
            const double *of = tangent + PCR_WATCH_WIDTH * j;
            slopes[j] = unit * 2.0 * (slope * load * of[0] + k * of[1]);
        }
        return unit * 2.0 * k * load;
    }
    const double m = w->record[PCR_LOADS(PCR_WATCH_WIDTH) + 3 * i + 2];
    for (int j = 0; j < 3; j++) {
        slopes[j] = copysign(unit, m) * w->record[PCR_LOAD_TANGENTS(PCR_WATCH_WIDTH) + 3 * (3 * i + j) + 2];
    }
    return unit * fabs(m);
}
#else
/* Where a rod is strained most, as a fraction of its length: the largest of its points, and a parabola through it and
   its neighbours, where no property changes its slope. */
static double strained_most(pcr_watch *w, const double *nodes, const double *physics, double ratio)
{
    double at_points[PCR_STRAIN_POINTS + 1];
    int at = 0;
    w->room.arg[0] = nodes;
    w->room.arg[1] = physics;
    w->room.arg[2] = &ratio;
    w->room.res[0] = at_points;
    pcr_graph_strain_along(w->room.arg, w->room.res, w->room.iw, w->room.w);
    for (int i = 1; i <= PCR_STRAIN_POINTS; i++) {
        at = at_points[i] > at_points[at] ? i : at;
    }
    if (at == 0 || at == PCR_STRAIN_POINTS || at * PCR_STRAIN_INTERVALS % PCR_STRAIN_POINTS == 0) {
        return (double)at / PCR_STRAIN_POINTS;
    }
    const double before = at_points[at - 1], here = at_points[at], after = at_points[at + 1];
    const double bent = before - 2.0 * here + after;
    return bent < 0.0 ? (at - (after - before) / (2.0 * bent)) / PCR_STRAIN_POINTS : (double)at / PCR_STRAIN_POINTS;
}

/* Share of its limit that rod i bears, and the derivatives of that by the pose: the point of the largest strain may stay,
   to first order, and follows from the node before it. */
static double share_of(pcr_watch *w, int i, double limit, const double *physics, double coarse, double *slopes)
{
    const int count = PCR_WATCH_WIDTH / 4;
    const double *nodes = w->record + PCR_UNKNOWNS + PCR_WATCH_WIDTH * i;
    const double *tangent = w->record + PCR_TANGENTS(PCR_WATCH_WIDTH) + 3 * PCR_WATCH_WIDTH * i;
    double value, gradient[4];
    memset(slopes, 0, 3 * sizeof *slopes);
    if (coarse < BETWEEN_NODES * PCR_STRAIN_WATCHED * limit) {
        return coarse / limit;
    }
    const double s = strained_most(w, nodes, physics, pcr_thickness[i]);
    const int node = s * count < count - 1 ? (int)(s * count) : count - 1;
    const double from = (double)node / count, beyond = s - from;
    w->room.arg[0] = nodes + 4 * node;
    w->room.arg[1] = &beyond;
    w->room.arg[2] = &from;
    w->room.arg[3] = physics;
    w->room.arg[4] = &pcr_thickness[i];
    w->room.res[0] = &value;
    w->room.res[1] = gradient;
    pcr_graph_strain_there(w->room.arg, w->room.res, w->room.iw, w->room.w);
    for (int j = 0; j < 3; j++) {
        for (int k = 0; k < 4; k++) {
            slopes[j] += gradient[k] * tangent[PCR_WATCH_WIDTH * j + 4 * node + k] / limit;
        }
    }
    return value / limit;
}
#endif

void pcr_strain(pcr_watch *w, int kind)
{
    const double *limits = w->controller->parameters.strain;
    double coarse[PCR_N] = {0.0}, physics[PCR_N * PCR_PHYSICS + 1], share[PCR_N], slopes[PCR_N][3];
    int near = 0;
#if PCR_WATCH_SHOT
    w->room.arg[0] = w->record + PCR_UNKNOWNS;
    w->room.arg[1] = w->controller->watch_numbers;
    w->room.arg[2] = pcr_thickness;
    w->room.res[0] = coarse;
    w->room.res[1] = physics;
    pcr_graph_strain_nodes(w->room.arg, w->room.res, w->room.iw, w->room.w);
#endif
    for (int i = 0; i < PCR_N; i++) {
        if (isfinite(limits[i])) {
            share[i] = share_of(w, i, limits[i], physics + i * PCR_PHYSICS, coarse[i], slopes[i]);
            near = near || share[i] > PCR_STRAIN_WATCHED;
        }
    }
    for (int i = 0; near && i < PCR_N; i++) {
        if (isfinite(limits[i])) {
            const int at = pcr_row(w, kind, limits[i]);
            pcr_by_state(w, at, i, slopes[i]);
            w->limits->upper[at] = 1.0 - share[i] + pcr_times_state(w, at);
        }
    }
}
