/* Which numbers a robot and its controller can have: those that Python's Robot, Limits and Tuning take. */
#include <math.h>
#include <stddef.h>
#include <string.h>

#include "pcr_parts.h"

#define MOST_MARGIN 0.9
#define MOST_STRAINED 0.2 /* beyond it no slender rod is a beam */

/* Place of a number that is refused, or -1. A rod's are stiffness, length, base x, base y, line density, its motor's
   lower and upper stop, ... */
static int refused_number(const double *numbers, const double (*ranges)[2], int count, int of_rod)
{
    for (int i = 0; i < count; i++) {
        if (!(isfinite(numbers[i]) && ranges[i][0] <= numbers[i] && numbers[i] <= ranges[i][1])) {
            return i;
        }
    }
    for (int i = 0; i < PCR_N; i++) {
        const double *rod = numbers + i * of_rod;
        if (!(rod[5] < rod[6])) {
            return i * of_rod + 5;
        }
        for (const double *other = numbers; other < rod; other += of_rod) {
            if (other[2] == rod[2] && other[3] == rod[3]) {
                return i * of_rod + 2;
            }
        }
    }
    return -1;
}

int pcr_plant_refused_number(const double *numbers)
{
    return refused_number(numbers, pcr_plant_number_ranges, PCR_PLANT_NUMBERS, PCR_PLANT_ROD_NUMBERS);
}

/* Whether a terminal weight is symmetric and weighs nothing negatively, but for rounding: by Cholesky. */
static int weighs(const double *terminal)
{
    double rest[PCR_STATES * PCR_STATES];
    memcpy(rest, terminal, sizeof rest);
    for (int k = 0; k < PCR_STATES; k++) {
        const double own = terminal[k * (PCR_STATES + 1)], left = rest[k * (PCR_STATES + 1)];
        if (!(left >= -1e-3 * own && own >= 0.0)) {
            return 0;
        }
        for (int i = k + 1; i < PCR_STATES; i++) {
            const double its = terminal[i * (PCR_STATES + 1)], one = terminal[i + PCR_STATES * k];
            /* Roots: the product itself could overflow in single precision. */
            const double most = its >= 0.0 ? sqrt(own) * sqrt(its) : -1.0;
            if (!(fabs(one - terminal[k + PCR_STATES * i]) <= 1e-3 * most)
                || (left <= 1e-3 * own && !(fabs(rest[i + PCR_STATES * k]) <= 0.04 * most))) {
                return 0;
            }
            for (int j = k + 1; left > 1e-3 * own && j < PCR_STATES; j++) {
                rest[j + PCR_STATES * i] -= rest[i + PCR_STATES * k] / sqrt(left) * (rest[j + PCR_STATES * k] / sqrt(left));
            }
        }
    }
    return 1;
}

/* Of a limit from below. */
static int none_or_positive(double limit)
{
    return isinf(limit) || limit >= 0.0;
}

/* Limits of poses that the scene does not have cannot be switched on: nothing watches them. */
int pcr_refused_parameter(const pcr_parameters *p)
{
    const double *all = (const double *)p, *refused = NULL;
    for (const double *at = all; at < all + sizeof *p / sizeof *all; at++) {
        if (isnan(*at) || (isinf(*at) && at < &p->rate)) { /* limits that are infinite are none */
            return (int)(at - all);
        }
    }
    const int number = refused_number(p->numbers, pcr_number_ranges, PCR_NUMBERS, PCR_ROD_NUMBERS);
    if (number >= 0) {
        return number;
    }
    for (int i = 3; i >= 0; i--) {
        const double weight = p->weights[i];
        const int positive = i == 0 || i == 3;
        if (!(positive ? weight > 0.0 : weight >= 0.0) || (pcr_scene_parameters.weights[i] == 0.0 && weight != 0.0)) {
            refused = p->weights + i;
        }
    }
    refused = weighs(p->terminal) ? refused : p->terminal;
    refused = p->rate > 0.0 ? refused : &p->rate;
    refused = p->rate_change > 0.0 ? refused : &p->rate_change;
    refused = p->reach > 0.0 && !isinf(p->reach) ? refused : &p->reach;
    refused = p->torque > 0.0 && (PCR_WATCHES_TORQUE || isinf(p->torque)) ? refused : &p->torque;
    refused = p->rod_margin <= MOST_MARGIN && none_or_positive(p->rod_margin) && (PCR_WATCHES_MARGIN || isinf(p->rod_margin))
                  ? refused
                  : &p->rod_margin;
    refused = p->stiffness < INFINITY && none_or_positive(p->stiffness) && (PCR_WATCHES_STIFFNESS || isinf(p->stiffness))
                  ? refused
                  : &p->stiffness;
    for (int i = 0; i < PCR_N; i++) {
        refused = p->angle_lower[i] <= p->angle_upper[i] ? refused : p->angle_lower + i;
        /* How many rows a kind has is settled when the code is written. */
        const int strained = p->strain[i] > 0.0 && (p->strain[i] <= MOST_STRAINED || isinf(p->strain[i]));
        refused = strained && !isfinite(p->strain[i]) == !isfinite(pcr_scene_parameters.strain[i]) ? refused : p->strain + i;
    }
    for (int i = 0; i < 2; i++) {
        refused = p->tip_lower[i] < p->tip_upper[i] && (PCR_WATCHES_TIP || isinf(p->tip_lower[i])) ? refused
                                                                                                    : p->tip_lower + i;
        refused = PCR_WATCHES_TIP || isinf(p->tip_upper[i]) ? refused : p->tip_upper + i;
    }
    return refused == NULL ? -1 : (int)(refused - all);
}
