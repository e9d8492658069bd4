/* How far rods are from their critical load. */
#include <math.h>

#include "pcr_graphs.h"
#include "pcr_watch.h"

#define LOOPED -13.0

/* lambda_c from the chart, good to a few per cent. */
static double rough_critical_load(double log_tip_angle)
{
    int i = 1;
    if (log_tip_angle <= pcr_critical_rows[0]) {
        return pcr_critical_loads[0];
    }
    if (log_tip_angle >= pcr_critical_rows[PCR_CRITICAL - 1]) {
        return pcr_critical_loads[PCR_CRITICAL - 1];
    }
    while (pcr_critical_rows[i] < log_tip_angle) {
        i++;
    }
    const double slope = (pcr_critical_loads[i] - pcr_critical_loads[i - 1])
                         / (pcr_critical_rows[i] - pcr_critical_rows[i - 1]);
    return pcr_critical_loads[i - 1] + slope * (log_tip_angle - pcr_critical_rows[i - 1]);
}

/* Of d(tip) / d(log tip_angle, load), whose first zero is where a rod with its tip held loses stability. */
static double determinant(const pcr_watch *w, double log_tip_angle, double load)
{
    double found;
    w->room.arg[0] = &log_tip_angle;
    w->room.arg[1] = &load;
    w->room.res[0] = &found;
    pcr_graph_determinant(w->room.arg, w->room.res, w->room.iw, w->room.w);
    return found;
}

/* Zero between low and high, where the determinant has two signs, by bisection and secants. */
static double zero(const pcr_watch *w, double log_tip_angle, double low, double high, double at_low, double at_high)
{
    for (int i = 0; i < 200 && high - low > PCR_NARROW; i++) {
        double middle = (low * at_high - high * at_low) / (at_high - at_low);
        if (i % 2 || !(middle > low && middle < high)) {
            middle = 0.5 * (low + high);
        }
        const double there = determinant(w, log_tip_angle, middle);
        if ((there < 0.0) == (at_low < 0.0)) {
            low = middle;
            at_low = there;
        } else {
            high = middle;
            at_high = there;
        }
    }
    return 0.5 * (low + high);
}

static double critical_load(const pcr_watch *w, double log_tip_angle)
{
    static const double widths[3] = {0.02, 0.1, 0.4};
    if (log_tip_angle < LOOPED) {
        const double full_loop = 2.0 * (log(8.0) - log_tip_angle), low = full_loop - 0.8, high = full_loop - 0.3;
        if (log_tip_angle - log(2.0) < -100.0) {
            return full_loop - 0.55;
        }
        return zero(w, log_tip_angle, low, high, determinant(w, log_tip_angle, low),
                    determinant(w, log_tip_angle, high));
    }
    const double guess = rough_critical_load(log_tip_angle);
    for (int i = 0; i < 3; i++) {
        const double low = guess * (1.0 - widths[i]), high = guess * (1.0 + widths[i]);
        const double at_low = determinant(w, log_tip_angle, low), at_high = determinant(w, log_tip_angle, high);
        if (at_low * at_high < 0.0) {
            return zero(w, log_tip_angle, low, high, at_low, at_high);
        }
    }
    return guess;
}

static double critical_load_slope(const pcr_watch *w, double log_tip_angle, double critical)
{
    const double h = PCR_DIFFERENCE;
    const double by_angle = determinant(w, log_tip_angle + h, critical) - determinant(w, log_tip_angle - h, critical);
    return -by_angle
           / (determinant(w, log_tip_angle, critical + h) - determinant(w, log_tip_angle, critical - h));
}

void pcr_rod_margins(pcr_watch *w, int kind)
{
    const double *unknowns = w->record + PCR_UNKNOWNS, *tangents = w->record + PCR_TANGENTS(PCR_WATCH_WIDTH);
    const double least = w->controller->parameters.rod_margin, watched = 1.0 - least - PCR_MARGIN_WATCHED;
    int near = 0;
    for (int i = 0; i < PCR_N; i++) {
        const double shape = unknowns[PCR_WATCH_WIDTH * i], load = unknowns[PCR_WATCH_WIDTH * i + 1];
        near = near || (load > watched * PCR_LEAST_CRITICAL_LOAD && load > watched * rough_critical_load(shape));
    }
    for (int i = 0; near && i < PCR_N; i++) {
        const double shape = unknowns[PCR_WATCH_WIDTH * i], load = unknowns[PCR_WATCH_WIDTH * i + 1];
        const double critical = critical_load(w, shape), slope = critical_load_slope(w, shape, critical);
        const int at = pcr_row(w, kind, 1.0);
        double by_pose[3];
        for (int j = 0; j < 3; j++) {
            const double *tangent = tangents + PCR_WATCH_WIDTH * (3 * i + j);
            by_pose[j] = (load / critical * slope * tangent[0] - tangent[1]) / critical;
        }
        pcr_by_state(w, at, i, by_pose);
        w->limits->lower[at] = least - (1.0 - load / critical) + pcr_times_state(w, at);
    }
}
