/* Hard limits of the motors. */
#include <math.h>
#include <stddef.h>

#include "pcr_parts.h"


static double least(double a, double b)
{
    return b < a ? b : a;
}

static double most(double a, double b)
{
    return b > a ? b : a;
}

/* Greatest rate towards a stop from which a motor can brake in time; negative where it must come back. */
static double fastest(const pcr_controller *controller, double room, double most_room)
{
    const double rate = controller->parameters.rate, change = controller->parameters.rate_change;
    if (room < 0.0) {
        return least(0.0, most_room);
    }
    if (room >= controller->clear) {
        return rate;
    }
    if (isinf(change)) {
        return room;
    }
    const double steps = floor((sqrt(1.0 + 8.0 * room / change) - 1.0) / 2.0);
    return room / (steps + 1.0) + change * steps / 2.0;
}

void pcr_kept(const pcr_controller *controller, const double *u, const double *previous, const double *q,
              const double *reckoned, double *kept)
{
    const pcr_parameters *limits = &controller->parameters;
    for (int i = 0; i < PCR_N; i++) {
        double now = u[i];
        const double at = q[i], also = reckoned == NULL ? at : reckoned[i], before = previous[i];
        if (isfinite(at)) {
            double low = at, high = at;
            if (fabs(also - at) > PCR_SAME_ANGLE) {
                low = least(at, also);
                high = most(at, also);
            }
            const double lower = limits->angle_lower[i], upper = limits->angle_upper[i];
            const double largest = fastest(controller, (upper - high) / PCR_PERIOD, (upper - low) / PCR_PERIOD);
            const double smallest = -fastest(controller, (low - lower) / PCR_PERIOD, (high - lower) / PCR_PERIOD);
            now = most(smallest, least(largest, now));
        }
        now = most(before - limits->rate_change, least(before + limits->rate_change, now));
        kept[i] = most(-limits->rate, least(limits->rate, now));
    }
}

void pcr_slowed(const pcr_controller *controller, const double *u, double *slowed)
{
    const double change = controller->parameters.rate_change;
    for (int i = 0; i < PCR_N; i++) {
        slowed[i] = most(u[i] - change, least(u[i] + change, 0.0));
    }
}

double pcr_clear_way(const pcr_parameters *parameters)
{
    const double rate = parameters->rate, change = parameters->rate_change;
    if (isinf(rate) || isinf(change)) {
        return rate;
    }
    const double steps = floor(rate / change);
    return (steps + 1.0) * (rate - change * steps / 2.0);
}

int pcr_met(const pcr_controller *controller, const double *u, const double *previous)
{
    const pcr_parameters *limits = &controller->parameters;
    int met = 0;
    for (int i = 0; i < PCR_N; i++) {
        met |= fabs(u[i]) >= limits->rate ? PCR_LIMIT_RATE : 0;
        met |= fabs(u[i] - previous[i]) >= limits->rate_change * (1.0 - PCR_MET) ? PCR_LIMIT_RATE_CHANGE : 0;
    }
    return met ? met : PCR_LIMIT_ANGLE;
}
