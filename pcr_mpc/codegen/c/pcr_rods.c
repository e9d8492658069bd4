/* The rods, from one pose to the next: a prediction and a few Newton iterations, or sub-steps of that. */
#include <math.h>
#include <string.h>

#include "pcr_graphs.h"
#include "pcr_parts.h"

#define BRANCH_CHANGE 0.3
#define LARGEST_DRIFT 1e-3
#define MOST_ITERATIONS 8
#define SMALLEST_SUBSTEP (1.0 / 1024.0)
/* Slacks, in lengths of a rod, between which the smallest sub-step shrinks with it, as what changes a rod does. */
#define STRAIGHTEST 1e-9
#define STRAIGHT 0.01

const pcr_rods pcr_model_rods = {pcr_graph_follow, pcr_graph_finish, PCR_WIDTH, PCR_FOLLOWING};
const pcr_rods pcr_target_rods = {pcr_graph_target_follow, pcr_graph_target_finish, PCR_TARGET_WIDTH,
                                  PCR_TARGET_FOLLOWING};
const pcr_rods pcr_watch_rods = {pcr_graph_watch_follow, pcr_graph_watch_finish, PCR_WATCH_WIDTH,
                                 PCR_WATCH_FOLLOWING};

pcr_room pcr_room_of(pcr_controller *c)
{
    pcr_room room;
    room.arg = c->arg;
    room.res = c->res;
    room.iw = c->iw;
    room.w = c->w;
    return room;
}

/* Newton's method from the prediction; `hasty`: given up unless it is nearly there after the first graph. */
static int climb(const pcr_rods *rods, const double *numbers, const double *p, const double *q, double derivatives,
                 int hasty, double *record, double *result, const pcr_room *room)
{
    double target[2 + PCR_N], start[PCR_LARGEST_RECORD], found[PCR_LARGEST_RECORD], verdict[5], of[PCR_RESULT];
    double changed = 0.0;
    const size_t size = PCR_RECORD_OF((size_t)rods->width) * sizeof *record;
    /* Where rough derivatives will do, one iteration usually does. */
    const int first = derivatives >= PCR_ROUGH ? 1 : 2, most = hasty ? first + 1 : MOST_ITERATIONS;
    memcpy(target, p, 2 * sizeof *target);
    memcpy(target + 2, q, PCR_N * sizeof *target);
    memcpy(start, record, size);
    for (int done = 0; done < most; done += done ? 1 : first) {
        room->arg[0] = target;
        room->arg[1] = start;
        room->arg[2] = numbers;
        room->res[0] = found;
        room->res[1] = verdict;
        room->res[2] = of;
        (done || first == 1 ? rods->once : rods->twice)(room->arg, room->res, room->iw, room->w);
        changed += verdict[2];
        /* Written so that NaN is a failure. */
        if (!(changed <= BRANCH_CHANGE && verdict[3] == 0.0) || (hasty && !(verdict[0] <= PCR_ROUGH))) {
            return 1;
        }
        if (verdict[0] <= rods->following && verdict[1] <= derivatives) {
            if (!(verdict[4] <= LARGEST_DRIFT)) {
                return 1;
            }
            memcpy(record, found, size);
            memcpy(result, of, sizeof of);
            return 0;
        }
        memcpy(start, found, size);
    }
    return 1;
}

/* How short the sub-steps may be from the poses of a record to others. */
static double smallest_substep(const double *numbers, const double *pose, const double *p)
{
    double straightest = 0.0;
    for (int i = 0; i < PCR_N; i++) {
        const double *of = numbers + i * PCR_ROD_NUMBERS;
        straightest = fmax(straightest, hypot(pose[3 * i], pose[3 * i + 1]));
        straightest = fmax(straightest, hypot(p[0] - of[2], p[1] - of[3]) / of[1]);
    }
    const double slack = 1.0 - straightest;
    return slack >= STRAIGHTEST && slack < STRAIGHT ? SMALLEST_SUBSTEP * slack / STRAIGHT : SMALLEST_SUBSTEP;
}

int pcr_follow(const pcr_rods *rods, const double *numbers, const double *p, const double *q, double derivatives,
               double *record, double *result, const pcr_room *room)
{
    if (!climb(rods, numbers, p, q, derivatives, 1, record, result, room)
        || !climb(rods, numbers, p, q, derivatives, 0, record, result, room)) {
        return 0;
    }
    /* Sub-steps along the straight line from the last pose, halved and doubled as they go. */
    const double *pose = record + PCR_POSES(rods->width);
    const double smallest = smallest_substep(numbers, pose, p);
    double from[2 + PCR_N], at[2 + PCR_N], moving[PCR_LARGEST_RECORD], done = 0.0, substep = 0.5;
    const size_t size = PCR_RECORD_OF((size_t)rods->width) * sizeof *record;
    memcpy(moving, record, size);
    for (int i = 0; i < 2; i++) {
        from[i] = numbers[2 + i] + numbers[1] * pose[i]; /* base + length pose, of the first rod */
    }
    for (int i = 0; i < PCR_N; i++) {
        from[2 + i] = pose[3 * i + 2];
    }
    while (done < 1.0) {
        const double next = done + substep >= 1.0 ? 1.0 : done + substep;
        for (int i = 0; i < 2 + PCR_N; i++) {
            const double to = i < 2 ? p[i] : q[i - 2];
            at[i] = next < 1.0 ? from[i] + next * (to - from[i]) : to;
        }
        if (climb(rods, numbers, at, at + 2, PCR_CLOSE, 0, moving, result, room)) {
            substep /= 2.0;
            if (substep < smallest) {
                return 1;
            }
        } else {
            done = next;
            substep *= 2.0;
        }
    }
    memcpy(record, moving, size);
    return 0;
}
