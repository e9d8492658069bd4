/* The data of the QP with soft rows: the factor of P, and all rows below each other. */
#include <math.h>
#include <stddef.h>
#include <string.h>

#include "pcr_limited.h"

int pcr_factorise(double factor[PCR_INPUTS][PCR_INPUTS], const double *p)
{
    for (int i = 0; i < PCR_INPUTS; i++) {
        for (int j = 0; j <= i; j++) {
            double sum = *p++;
            for (int k = 0; k < j; k++) {
                sum -= factor[i][k] * factor[j][k];
            }
            if (i > j) {
                factor[i][j] = sum / factor[j][j];
            } else if (sum > 0.0) { /* not of NaN */
                factor[i][i] = sqrt(sum);
            } else {
                return 1;
            }
        }
    }
    return 0;
}

void pcr_stack(pcr_limited *limited, const double *models, const double *x, double dt, const pcr_pose_limits *limits,
               double *low, double *high)
{
    double (*a)[PCR_LIMITED_ROWS] = limited->stacked;
    for (int j = 0; j < PCR_INPUTS; j++) {
        for (int i = 0; i < PCR_INPUTS; i++) {
            a[j][i] = i == j ? 1.0 : 0.0;
            a[j][PCR_INPUTS + i] = i == j ? 1.0 : i == j + PCR_N ? -1.0 : 0.0;
            a[j][2 * PCR_INPUTS + i] = i >= j && (i - j) % PCR_N == 0 ? 1.0 : 0.0;
        }
    }
    if (limits == NULL) {
        return;
    }
    double response[PCR_INPUTS][PCR_STATES] = {{0.0}}, state[PCR_STATES], moved[PCR_STATES];
    memcpy(state, x, sizeof state);
    for (int k = 0; k < PCR_HORIZON; k++) {
        const double *model = models + (PCR_MODELS > 1 ? k : 0) * PCR_MODEL;
        const double *c = model + PCR_STATES * PCR_STATES, *b = c + PCR_STATES;
        for (int j = 0; j < (k + 1) * PCR_N; j++) {
            for (int i = 0; i < PCR_STATES; i++) {
                moved[i] = j >= k * PCR_N ? b[i + PCR_STATES * (j - k * PCR_N)] : 0.0;
                for (int l = 0; l < PCR_STATES && j < k * PCR_N; l++) {
                    moved[i] += model[i + PCR_STATES * l] * response[j][l];
                }
            }
            memcpy(response[j], moved, sizeof moved);
        }
        for (int i = 0; i < PCR_STATES; i++) {
            moved[i] = c[i];
            for (int l = 0; l < PCR_STATES; l++) {
                moved[i] += model[i + PCR_STATES * l] * state[l];
            }
        }
        memcpy(state, moved, sizeof state);
        for (int i = 0; i < limits->count; i++) {
            const int row = PCR_MOTOR_ROWS + k * limits->count + i;
            double free = 0.0;
            for (int l = 0; l < PCR_STATES; l++) {
                free += limits->c[i][l] * state[l];
            }
            low[row] = (limits->lower[i] - free) / dt;
            high[row] = (limits->upper[i] - free) / dt;
            for (int j = 0; j < PCR_INPUTS; j++) {
                double sum = 0.0;
                for (int l = 0; l < PCR_STATES; l++) {
                    sum += limits->c[i][l] * response[j][l];
                }
                a[j][row] = sum / dt;
            }
        }
    }
}
