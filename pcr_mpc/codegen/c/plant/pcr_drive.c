/* The motors of the plant: from commanded rates to those at which the clamps turn, constant within a step of the plant. */
#include <math.h>
#include <string.h>

#include "pcr_parts.h"

#define SAME_RATE 1e-9 /* a rate that was turned into an angle and back has lost digits [rad/s] */

static double within(double value, double lower, double upper)
{
    return value < lower ? lower : value > upper ? upper : value;
}

void pcr_drive_start(pcr_drive *drive, const double *q)
{
    memset(drive, 0, sizeof *drive);
    memcpy(drive->shaft, q, sizeof drive->shaft);
    memcpy(drive->wanted, q, sizeof drive->wanted);
}

void pcr_drive_turn(pcr_drive *drive, const double *numbers, const double *q, const double *u, double *rates)
{
    const double dt = PCR_PLANT_STEP, limit = numbers[PCR_PLANT_NUMBERS - 1];
    for (int i = 0; i < PCR_N; i++) {
        const double *of = numbers + i * PCR_PLANT_ROD_NUMBERS;
        const double lower = of[5], upper = of[6], play = PCR_MOTOR_PLAY;
        double shaft = within(drive->shaft[i], q[i] - play, q[i] + play), told = within(u[i], -limit, limit);
        if (PCR_MOTOR_ANGLES) {
            const double behind = drive->wanted[i] - shaft;
            drive->wanted[i] = within(drive->wanted[i] + dt * told, lower, upper);
            if (PCR_MOTOR_LAG > 0.0) {
                drive->rate[i] = behind / (PCR_MOTOR_LAG > 0.0 ? PCR_MOTOR_LAG : 1.0);
            } else {
                told = (drive->wanted[i] - shaft) / dt;
            }
        }
        const double wanted = told + PCR_MOTOR_MEAN * (drive->rate[i] - told);
        const double free = within(wanted, -limit, limit);
        const double turning = within((within(shaft + dt * free, lower, upper) - shaft) / dt, -limit, limit);
        shaft += dt * turning;
        rates[i] = play > 0.0 ? (within(q[i], shaft - play, shaft + play) - q[i]) / dt : turning;
        drive->rate[i] = fabs(turning - wanted) <= SAME_RATE ? told + PCR_MOTOR_LEFT * (drive->rate[i] - told) : turning;
        drive->shaft[i] = shaft;
    }
}

pcr_result pcr_plant_angles(const pcr_plant *plant, double *q)
{
    if (pcr_plant_status(plant) != PCR_OK) {
        return PCR_NOT_STARTED;
    }
    if (q == NULL) {
        return PCR_ARGUMENT;
    }
    for (int i = 0; i < PCR_N; i++) {
        const double clamp = plant->x[4 + i];
        q[i] = PCR_MOTORS ? within(plant->drive.shaft[i], clamp - PCR_MOTOR_PLAY, clamp + PCR_MOTOR_PLAY) : clamp;
    }
    return PCR_OK;
}
