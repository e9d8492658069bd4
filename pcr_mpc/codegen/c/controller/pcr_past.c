/* Estimates of the last periods: what a late tip is compared with, and corrects. A correction of the past is moved on to
   the present by the linear models of the periods in between. */
#include <math.h>
#include <stddef.h>
#include <string.h>

#include "pcr_parts.h"

void pcr_past_clear(pcr_controller *c)
{
    c->past_count = 0;
}

/* Period of the picture among those that are remembered; `later`: the fraction of a period after it. */
static int when(const pcr_controller *c, double *later)
{
    const double at = fmax(c->past_count - PCR_PAST_AGE, 0.0), whole = fmin(floor(at + 1e-9), c->past_count);
    *later = fmax(at - whole, 0.0);
    return (int)whole;
}

void pcr_past_tip(const pcr_controller *c, const double *now, double *tip)
{
    double s;
    const int whole = when(c, &s);
    const double *start = whole < c->past_count ? c->past[whole] : now;
    memcpy(tip, start, 2 * sizeof *tip);
    if (s > 0.0 && whole + 1 <= c->past_count) {
        /* Hermite's cubic: positions and velocities at both ends are known. */
        const double *end = whole + 1 < c->past_count ? c->past[whole + 1] : now;
        for (int i = 0; i < 2; i++) {
            tip[i] = (1.0 + 2.0 * s) * ((1.0 - s) * (1.0 - s)) * start[i]
                     + s * ((1.0 - s) * (1.0 - s)) * PCR_PERIOD * start[2 + i] + s * s * (3.0 - 2.0 * s) * end[i]
                     - s * s * (1.0 - s) * PCR_PERIOD * end[2 + i];
        }
    }
}

void pcr_past_correct(pcr_controller *c, double *change)
{
    double s;
    for (int j = when(c, &s); j < c->past_count; j++) {
        double moved[6];
        for (int i = 0; i < 6; i++) {
            c->past[j][i] += change[i];
            moved[i] = i < 4 ? 0.0 : change[i];
            for (int k = 0; k < 6 && i < 4; k++) {
                moved[i] += c->past_moves[j][i][k] * change[k];
            }
        }
        memcpy(change, moved, sizeof moved);
    }
}

void pcr_past_remember(pcr_controller *c, const double *corrected, const double *model)
{
    const double *by_force = model + PCR_STATES * (PCR_STATES + 1 + PCR_N);
    const size_t most = PCR_PAST > 0 ? PCR_PAST - 1 : 0;
    if (c->past_count == PCR_PAST) {
        memmove(c->past[0], c->past + 1, most * sizeof c->past[0]);
        memmove(c->past_moves[0], c->past_moves + 1, most * sizeof c->past_moves[0]);
        c->past_count--;
    }
    double *at = c->past[c->past_count];
    memcpy(at, corrected, 4 * sizeof *at);
    memcpy(at + 4, corrected + PCR_STATES, 2 * sizeof *at);
    for (int i = 0; i < 4; i++) {
        for (int k = 0; k < 6; k++) {
            c->past_moves[c->past_count][i][k] = k < 4 ? model[i + PCR_STATES * k] : by_force[i + PCR_STATES * (k - 4)];
        }
    }
    c->past_count++;
}
