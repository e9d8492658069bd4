/* Limits of the pose ahead, linear in the state, where they come near. */
#include <math.h>
#include <string.h>

#include "pcr_graphs.h"
#include "pcr_watch.h"

#define TORQUE_WATCHED 0.6
#define MARGIN_WATCHED 0.25
#define STIFFNESS_WATCHED 3.0
#define LEAST_CRITICAL_LOAD 5.7659
#define LOOPED -13.0

/* Whether no limit can be near, by what the graph says of the pose ahead: the least eigenvalue of K, torques, and the
   shapes and loads of the rods. NaN is not far. */
static int far(const pcr_controller *controller)
{
    const pcr_parameters *of = &controller->parameters;
    const double *signs = controller->out + PCR_OUT_SIGNS, *loads = signs + 1 + 2 * PCR_N;
    double greatest = -INFINITY;
    if (PCR_WATCHES_TIP) {
        return 0;
    }
    for (int i = 0; i < PCR_N; i++) {
        if (PCR_WATCHES_STRAIN && isfinite(of->strain[i])
            && !(2.0 * loads[i] * pcr_thickness[i] < PCR_STRAIN_WATCHED * of->strain[i])) {
            return 0;
        }
        if (PCR_WATCHES_TORQUE && !(fabs(signs[1 + i]) < TORQUE_WATCHED * of->torque)) {
            return 0;
        }
        greatest = loads[i] > greatest || isnan(loads[i]) ? loads[i] : greatest;
    }
    if (PCR_WATCHES_STIFFNESS && !(signs[0] > STIFFNESS_WATCHED * of->stiffness)) {
        return 0;
    }
    return !PCR_WATCHES_MARGIN || greatest <= (1.0 - of->rod_margin - MARGIN_WATCHED) * LEAST_CRITICAL_LOAD;
}

const double *pcr_rod(const pcr_watch *w, int i)
{
    return w->controller->parameters.numbers + i * PCR_ROD_NUMBERS;
}

int pcr_row(pcr_watch *w, int kind, double scale)
{
    const int at = w->limits->count++;
    memset(w->limits->c[at], 0, sizeof w->limits->c[at]);
    w->limits->kind[at] = kind;
    w->limits->kinds |= 1 << kind;
    w->limits->scale[at] = scale;
    w->limits->lower[at] = -INFINITY;
    w->limits->upper[at] = INFINITY;
    return at;
}

double pcr_times_state(const pcr_watch *w, int at)
{
    double sum = 0.0;
    for (int l = 0; l < PCR_STATES; l++) {
        sum += w->limits->c[at][l] * w->x[l];
    }
    return sum;
}

void pcr_by_state(const pcr_watch *w, int at, int i, const double *by_pose)
{
    w->limits->c[at][0] += by_pose[0] / pcr_rod(w, i)[1];
    w->limits->c[at][1] += by_pose[1] / pcr_rod(w, i)[1];
    w->limits->c[at][4 + i] += by_pose[2];
}

static void torque(pcr_watch *w, int kind)
{
    const double *loads = w->record + PCR_LOADS(PCR_WATCH_WIDTH);
    const double *moves = w->record + PCR_LOAD_TANGENTS(PCR_WATCH_WIDTH);
    const double limit = w->controller->parameters.torque;
    double largest = 0.0;
    for (int i = 0; i < PCR_N; i++) {
        const double tau = fabs(pcr_rod(w, i)[0] / pcr_rod(w, i)[1] * loads[3 * i + 2]);
        largest = tau > largest ? tau : largest;
    }
    if (largest < TORQUE_WATCHED * limit) {
        return;
    }
    for (int i = 0; i < PCR_N; i++) {
        const int at = pcr_row(w, kind, limit);
        const double unit = pcr_rod(w, i)[0] / pcr_rod(w, i)[1] / limit;
        double slopes[3];
        for (int j = 0; j < 3; j++) {
            slopes[j] = -unit * moves[3 * (3 * i + j) + 2];
        }
        pcr_by_state(w, at, i, slopes);
        const double rest = -unit * loads[3 * i + 2] - pcr_times_state(w, at);
        w->limits->lower[at] = -1.0 - rest;
        w->limits->upper[at] = 1.0 - rest;
    }
}

static void tip_region(pcr_watch *w, int kind)
{
    double unit = 0.0;
    for (int i = 0; i < PCR_N; i++) {
        unit += pcr_rod(w, i)[1] / PCR_N;
    }
    for (int j = 0; j < 2; j++) {
        const int at = pcr_row(w, kind, unit);
        w->limits->c[at][j] = 1.0 / unit;
        w->limits->lower[at] = w->controller->parameters.tip_lower[j] / unit;
        w->limits->upper[at] = w->controller->parameters.tip_upper[j] / unit;
    }
}

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

static void rod_margins(pcr_watch *w, int kind)
{
    const double *unknowns = w->record + PCR_UNKNOWNS, *tangents = w->record + PCR_TANGENTS(PCR_WATCH_WIDTH);
    const double least = w->controller->parameters.rod_margin, watched = 1.0 - least - MARGIN_WATCHED;
    int near = 0;
    for (int i = 0; i < PCR_N; i++) {
        const double shape = unknowns[PCR_WATCH_WIDTH * i], load = unknowns[PCR_WATCH_WIDTH * i + 1];
        near = near || (load > watched * LEAST_CRITICAL_LOAD && load > watched * rough_critical_load(shape));
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

static void stiffness(pcr_watch *w, int kind)
{
    const double *k = w->result + 2, least = w->controller->parameters.stiffness;
    const double a = k[0], b = k[2], e = k[3], softest = (a + e) / 2.0 - hypot((a - e) / 2.0, b);
    if (softest > STIFFNESS_WATCHED * least) {
        return;
    }
    /* Its eigenvector, from the row of K - softest I that is longer. */
    double v[2] = {b, softest - a}, other[2] = {softest - e, b};
    if (hypot(other[0], other[1]) > hypot(v[0], v[1])) {
        memcpy(v, other, sizeof v);
    }
    const double length = hypot(v[0], v[1]);
    if (length > 0.0) {
        v[0] /= length;
        v[1] /= length;
    } else {
        v[0] = 1.0;
    }
    const int at = pcr_row(w, kind, least);
    for (int i = 0; i < PCR_N; i++) {
        const double *of = pcr_rod(w, i), unit = of[0] / (of[1] * of[1] * of[1]) / least;
        double curvature[12], by_pose[3];
        w->room.arg[0] = w->record + PCR_UNKNOWNS + PCR_WATCH_WIDTH * i;
        w->room.arg[1] = w->record + PCR_POSES(PCR_WATCH_WIDTH) + 3 * i;
        w->room.res[0] = curvature;
        pcr_graph_curvature(w->room.arg, w->room.res, w->room.iw, w->room.w);
        for (int j = 0; j < 3; j++) {
            const double *of_k = curvature + 4 * j;
            by_pose[j] = unit * (v[0] * v[0] * of_k[0] + v[0] * v[1] * (of_k[1] + of_k[2]) + v[1] * v[1] * of_k[3]);
        }
        pcr_by_state(w, at, i, by_pose);
    }
    w->limits->lower[at] = 1.0 - softest / least + pcr_times_state(w, at);
}

int pcr_near(pcr_controller *controller, pcr_pose_limits *limits)
{
    double following[PCR_WATCH_RECORD];
    const double *ahead = controller->out + PCR_OUT_AHEAD;
    const double *from = controller->out + PCR_OUT_FOLLOWED + PCR_DELAY * PCR_RECORD;
    limits->kinds = limits->count = 0;
    if (PCR_POSE_KINDS == 0 || (PCR_WATCH_FOLLOWS && far(controller))) {
        return 0;
    }
    pcr_watch w;
    w.controller = controller;
    w.limits = limits;
    w.x = ahead;
    w.record = PCR_WATCH_FOLLOWS ? following : controller->watch_record;
    w.result = controller->watch_result;
    w.room.arg = controller->arg;
    w.room.res = controller->res;
    w.room.iw = controller->iw;
    w.room.w = controller->w;
    if (PCR_WATCH_FOLLOWS) {
        memcpy(following, from, sizeof following);
    }
    /* Rods of their own go on from where they are, and stay there if that is the pose. */
    const int moved = PCR_WATCH_FOLLOWS || memcmp(controller->watch_at, ahead, 2 * sizeof *ahead) != 0
                      || memcmp(controller->watch_at + 2, ahead + 4, PCR_N * sizeof *ahead) != 0;
    if (moved) {
        controller->watch_at[0] = NAN;
        if (pcr_follow(&pcr_watch_rods, controller->watch_numbers, ahead, ahead + 4, PCR_CLOSE, w.record,
                       controller->watch_result, w.room)) {
            return 1;
        }
        memcpy(controller->watch_at, ahead, 2 * sizeof *ahead);
        memcpy(controller->watch_at + 2, ahead + 4, PCR_N * sizeof *ahead);
    }
    int kind = 0;
    if (PCR_WATCHES_TORQUE) {
        torque(&w, kind++);
    }
    if (PCR_WATCHES_TIP) {
        tip_region(&w, kind++);
    }
    if (PCR_WATCHES_MARGIN) {
        rod_margins(&w, kind++);
    }
    if (PCR_WATCHES_STIFFNESS) {
        stiffness(&w, kind++);
    }
    if (PCR_WATCHES_STRAIN) {
        pcr_strain(&w, kind++);
    }
    return 0;
}
