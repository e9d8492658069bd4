/* The ladder below the QP: the last plan, the LQR, or rest. */
#include <math.h>
#include <string.h>

#include "pcr_parts.h"

/* Rates of the LQR about where the reference is now, one period before its first state. */
static void lqr(const pcr_controller *c, const double *x, const double *wanted, const double *inputs, double *u)
{
    double away[PCR_STATES];
    for (int i = 0; i < PCR_STATES; i++) {
        double now = wanted[i];
        now -= i < 2 ? PCR_PERIOD * wanted[2 + i] : i >= 4 ? PCR_PERIOD * inputs[i - 4] : 0.0;
        away[i] = x[i] - now;
    }
    for (int i = 0; i < PCR_N; i++) {
        u[i] = inputs[i];
        for (int j = 0; j < PCR_STATES; j++) {
            u[i] -= c->parameters.gain[i * PCR_STATES + j] * away[j];
        }
    }
}

void pcr_fall_back(pcr_controller *c, const double *x, const double *wanted, const double *window,
                   pcr_output *output)
{
    int finite = 1;
    double asked[PCR_N];
    for (int i = 0; i < PCR_STATES; i++) {
        finite = finite && isfinite(x[i]);
    }
    if (c->has_plan && c->age >= 0 && c->age < PCR_HORIZON - 1) {
        output->rung = PCR_SHIFTED_PLAN;
        memmove(c->inputs[0], c->inputs[PCR_HORIZON > 1 ? 1 : 0], (PCR_HORIZON - 1) * sizeof c->inputs[0]);
    } else {
        output->rung = finite ? PCR_LQR : PCR_HOLD;
        memset(c->inputs, 0, sizeof c->inputs);
        if (finite) {
            lqr(c, x, wanted, window + PCR_STATES, c->inputs[0]);
        }
    }
    memcpy(asked, c->inputs[0], sizeof asked);
    pcr_kept(c, asked, c->u, x + 4, NULL, c->inputs[0]);
    for (int k = output->rung == PCR_SHIFTED_PLAN ? PCR_HORIZON - 1 : 1; k > 0 && k < PCR_HORIZON; k++) {
        pcr_slowed(c, c->inputs[k - 1], c->inputs[k]);
    }
    output->active = 0;
    for (int i = 0; i < PCR_N; i++) {
        if (c->inputs[0][i] != asked[i]) {
            output->active = pcr_met(c, c->inputs[0], c->u);
        }
    }
    memset(output->slack, 0, sizeof output->slack);
    output->iterations = 0;
    output->primal_residual = output->dual_residual = NAN;
    c->age += c->age >= 0;
    c->has_states = c->has_models = c->has_plan && c->has_models && finite;
    if (c->has_states) {
        pcr_predict_states(c, c->models, x);
    }
    c->has_plan = 1;
}
