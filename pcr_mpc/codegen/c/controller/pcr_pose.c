/* Limits of the pose ahead, linear in the state, where they come near. */
#include <math.h>
#include <string.h>

#include "pcr_graphs.h"
#include "pcr_watch.h"

#define TORQUE_WATCHED 0.6
#define STIFFNESS_WATCHED 3.0

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
    return !PCR_WATCHES_MARGIN || greatest <= (1.0 - of->rod_margin - PCR_MARGIN_WATCHED) * PCR_LEAST_CRITICAL_LOAD;
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
                       controller->watch_result, &w.room)) {
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
        pcr_rod_margins(&w, kind++);
    }
    if (PCR_WATCHES_STIFFNESS) {
        stiffness(&w, kind++);
    }
    if (PCR_WATCHES_STRAIN) {
        pcr_strain(&w, kind++);
    }
    return 0;
}
