/* What the rates of a plan lead to. */
#include <math.h>
#include <string.h>

#include "pcr_graphs.h"
#include "pcr_parts.h"

void pcr_check(pcr_controller *c)
{
    static const int places[] = {PCR_CHECK_MODELS, PCR_CHECK_X, PCR_CHECK_P, PCR_CHECK_Q, PCR_CHECK_L, PCR_CHECK_U,
                                 PCR_CHECK_BOUNDS, PCR_CHECK_DT, PCR_CHECK_CLEAR, PCR_CHECK_INPUTS, PCR_CHECK_Y};
    for (int i = 0; i < (int)(sizeof places / sizeof *places); i++) {
        c->arg[i] = c->check_in + places[i];
    }
    c->res[0] = c->check_out;
    c->res[1] = c->check_out + (PCR_HORIZON + 1) * PCR_STATES;
    pcr_graph_check(c->arg, c->res, c->iw, c->w);
}

void pcr_predict_states(pcr_controller *c, const double *models, const double *x)
{
    memcpy(c->check_in + PCR_CHECK_MODELS, models, PCR_MODELS * PCR_MODEL * sizeof *models);
    memcpy(c->check_in + PCR_CHECK_X, x, PCR_STATES * sizeof *x);
    memcpy(c->check_in + PCR_CHECK_INPUTS, c->inputs, sizeof c->inputs);
    pcr_check(c);
    memcpy(c->states, c->check_out, sizeof c->states);
}

double pcr_broken_by(const pcr_controller *c, const pcr_pose_limits *limits, double angles)
{
    double broken = angles;
    for (int k = 1; k <= PCR_HORIZON; k++) {
        for (int i = 0; i < limits->count; i++) {
            double value = 0.0;
            for (int j = 0; j < PCR_STATES; j++) {
                value += limits->c[i][j] * c->check_out[k * PCR_STATES + j];
            }
            broken = fmax(broken, fmax(limits->lower[i] - value, value - limits->upper[i]));
        }
    }
    return broken;
}
