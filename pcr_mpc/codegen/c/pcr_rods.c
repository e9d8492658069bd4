/* The rods, from one pose to the next: a prediction and two or three Newton iterations, or sub-steps of that. */
#include <math.h>
#include <string.h>

#include "pcr_parts.h"

#define ROUGH 1e-4
#define BRANCH_CHANGE 0.3
#define FOLLOWING 1e-11
#define LARGEST_DRIFT 1e-3
#define SMALLEST_SUBSTEP (1.0 / 1024.0)

int pcr_climb(pcr_graph *first, pcr_graph *once, const double *numbers, const double *p, const double *q,
              double derivatives, double *record, double *result, pcr_room room)
{
    double target[2 + PCR_N], start[PCR_RECORD], found[PCR_RECORD], verdict[5], of[PCR_RESULT], changed = 0.0;
    memcpy(target, p, 2 * sizeof *target);
    memcpy(target + 2, q, PCR_N * sizeof *target);
    memcpy(start, record, sizeof start);
    for (int round = 0; round < 2; round++) {
        room.arg[0] = target;
        room.arg[1] = start;
        room.arg[2] = numbers;
        room.res[0] = found;
        room.res[1] = verdict;
        room.res[2] = of;
        (round ? once : first)(room.arg, room.res, room.iw, room.w);
        changed += verdict[2];
        /* Written so that NaN is a failure. */
        if (!(verdict[0] <= ROUGH && changed <= BRANCH_CHANGE && verdict[3] == 0.0)) {
            return 1;
        }
        if (verdict[0] <= FOLLOWING && verdict[1] <= derivatives) {
            if (!(verdict[4] <= LARGEST_DRIFT)) {
                return 1;
            }
            memcpy(record, found, sizeof found);
            memcpy(result, of, sizeof of);
            return 0;
        }
        memcpy(start, found, sizeof found);
    }
    return 1;
}

int pcr_follow(pcr_graph *twice, pcr_graph *once, const double *numbers, const double *p, const double *q,
               double derivatives, double *record, double *result, pcr_room room)
{
    if (!pcr_climb(derivatives >= ROUGH ? once : twice, once, numbers, p, q, derivatives, record, result, room)) {
        return 0;
    }
    /* Sub-steps along the straight line from the last pose, halved and doubled as they go. */
    const double *pose = record + PCR_POSES;
    double from[2 + PCR_N], at[2 + PCR_N], moving[PCR_RECORD], done = 0.0, substep = 0.5;
    memcpy(moving, record, sizeof moving);
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
        if (pcr_climb(twice, once, numbers, at, at + 2, 1e-6, moving, result, room)) {
            substep /= 2.0;
            if (substep < SMALLEST_SUBSTEP) {
                return 1;
            }
        } else {
            done = next;
            substep *= 2.0;
        }
    }
    memcpy(record, moving, sizeof moving);
    return 0;
}
