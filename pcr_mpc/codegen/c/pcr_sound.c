/* Which numbers a robot and its controller can have: those that Python's Robot, Limits and Tuning take. */
#include <math.h>
#include <stddef.h>

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

/* Whether a terminal weight is symmetric, and no square of two states has a negative one, but for rounding. */
static int weighs(const double *terminal)
{
    for (int i = 0; i < PCR_STATES; i++) {
        for (int j = 0; j <= i; j++) {
            const double one = terminal[i + PCR_STATES * j], other = terminal[j + PCR_STATES * i];
            const double own = terminal[i * (PCR_STATES + 1)], its = terminal[j * (PCR_STATES + 1)];
            /* Product of the roots: the product itself could overflow in single precision. */
            const double most = own >= 0.0 && its >= 0.0 ? 1.001 * sqrt(own) * sqrt(its) : -1.0;
            if (!(fabs(one) <= most && fabs(one - other) <= 1e-3 * most)) {
                return 0;
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
    refused = p->torque > 0.0 ? refused : &p->torque;
    refused = p->rod_margin <= MOST_MARGIN && none_or_positive(p->rod_margin) ? refused : &p->rod_margin;
    refused = p->stiffness < INFINITY && none_or_positive(p->stiffness) ? refused : &p->stiffness;
    for (int i = 0; i < PCR_N; i++) {
        refused = p->angle_lower[i] <= p->angle_upper[i] ? refused : p->angle_lower + i;
        refused = p->strain[i] > 0.0 && (p->strain[i] <= MOST_STRAINED || isinf(p->strain[i])) ? refused : p->strain + i;
    }
    for (int i = 0; i < 2; i++) {
        refused = p->tip_lower[i] < p->tip_upper[i] ? refused : p->tip_lower + i;
    }
    return refused == NULL ? -1 : (int)(refused - all);
}
