/* Which measurements are believed: those of places where the robot can be. */
#include <math.h>
#include <string.h>

#include "pcr_parts.h"

#define TIP_ECHO 3.0
#define ANGLE_ECHO 1.0
#define TOO_LONG 0.02
#define OTHER_UNITS 20.0
#define PATIENCE 30
#define TURN 6.283185307179586477
#define TURN_IN_A_PERIOD(c) ((c)->parameters.rate * PCR_PERIOD * (1.0 + 1e-9) + PCR_ANGLE_STEP)

/* What speaks against a reading. */
typedef enum { ODD_NOT, ODD, ODD_UNITS } oddity;

static void believed(pcr_sensor *sensor, double surprise)
{
    sensor->known = sensor->agreeing = 0;
    sensor->surprise = surprise > sensor->surprise / 2.0 ? surprise : sensor->surprise / 2.0;
}

/* Count a reading that was not believed; returns whether it has insisted long enough. */
static int refused(pcr_sensor *sensor, const double *reading, int count, double near)
{
    int agrees = sensor->known;
    for (int i = 0; i < count; i++) {
        agrees = agrees && fabs(reading[i] - sensor->last[i]) <= near; /* NaN agrees with nothing */
        sensor->last[i] = reading[i];
    }
    sensor->known = 1;
    sensor->surprise /= 2.0;
    sensor->agreeing = agrees ? sensor->agreeing + 1 : 1;
    return sensor->agreeing >= PATIENCE;
}

static const double *rod(const pcr_controller *controller, int i)
{
    return controller->parameters.numbers + i * PCR_ROD_NUMBERS; /* stiffness, length, base x, base y, ... */
}

static int too_far(const pcr_controller *controller, const double *p, double tolerance)
{
    for (int i = 0; i < PCR_N; i++) {
        const double *of = rod(controller, i);
        if (!(hypot(p[0] - of[2], p[1] - of[3]) < of[1] * (1.0 + tolerance))) {
            return 1;
        }
    }
    return 0;
}

static double near_tip(const pcr_controller *controller)
{
    double shortest = INFINITY;
    for (int i = 0; i < PCR_N; i++) {
        const double length = rod(controller, i)[1];
        shortest = length < shortest ? length : shortest;
    }
    return 0.0125 * shortest + 10.0 * PCR_TIP_NOISE;
}

static oddity odd_tip(const pcr_controller *controller, const double *x, const double *expected)
{
    const double near = near_tip(controller) + TIP_ECHO * controller->tip.surprise;
    const double away = hypot(x[0] - expected[0], x[1] - expected[1]);
    /* So written that NaN is odd. */
    if (away <= near && !too_far(controller, x, TOO_LONG)) {
        if (PCR_OBSERVER || PCR_PERIOD * hypot(x[2] - expected[2], x[3] - expected[3]) <= near) {
            return ODD_NOT;
        }
        return ODD;
    }
    for (double unit = 1e2; isfinite(away) && unit <= 1e3; unit *= 10.0) { /* centimetres, millimetres */
        const double from = hypot(x[0] / unit - expected[0], x[1] / unit - expected[1]);
        if ((unit == 1e3 && from <= near)
            || (too_far(controller, x, TOO_LONG) && from <= OTHER_UNITS * near_tip(controller))) {
            return ODD_UNITS;
        }
    }
    return ODD;
}

static oddity odd_angles(const pcr_controller *controller, const double *q)
{
    const double turn = TURN_IN_A_PERIOD(controller) + ANGLE_ECHO * controller->encoders.surprise;
    int odd = 0, finite = 1, turned = 0, turns = 1, degrees = 1;
    for (int i = 0; i < PCR_N; i++) {
        const double jump = q[i] - controller->before[i];
        odd = odd || !(-turn <= jump && jump <= turn);
        finite = finite && isfinite(q[i]);
    }
    if (!odd) {
        return ODD_NOT;
    }
    for (int i = 0; i < PCR_N && finite; i++) {
        const double jump = q[i] - controller->before[i], whole = TURN * rint(jump / TURN);
        turned = turned || whole != 0.0;
        turns = turns && fabs(jump - whole) <= turn;
        degrees = degrees && fabs(q[i] * (TURN / 360.0) - controller->before[i]) <= turn;
    }
    return finite && ((turned && turns) || degrees) ? ODD_UNITS : ODD;
}

void pcr_gate_start(pcr_controller *controller, const double *q)
{
    memset(&controller->tip, 0, sizeof controller->tip);
    memset(&controller->encoders, 0, sizeof controller->encoders);
    memcpy(controller->before, q, sizeof controller->before);
    controller->first = 1;
    controller->without = 0;
    pcr_past_clear(controller);
}

static double unwrapped(double angle, double expected)
{
    return isfinite(angle) ? angle + TURN * rint((expected - angle) / TURN) : angle;
}

pcr_result pcr_believe(pcr_controller *controller, const pcr_measurement *measured, int *doubts)
{
    double *expected = controller->in + PCR_IN_ESTIMATE, *given = controller->in + PCR_IN_MEASURED;
    const double turn = TURN_IN_A_PERIOD(controller);
    double due[PCR_STATES], told[PCR_STATES], velocity[2], then[2];
    memcpy(due, expected, sizeof due);
    memcpy(told, measured->p, 2 * sizeof *told);
    if (PCR_PAST) {
        /* As far from where it is expected as it was from where it was when the picture was taken. */
        double now[PCR_STATES + 2];
        memcpy(now, expected, sizeof now);
        pcr_past_tip(controller, now, then);
        told[0] += due[0] - then[0];
        told[1] += due[1] - then[1];
    }
    memcpy(told + 2, measured->v, 2 * sizeof *told);
    for (int i = 0; i < PCR_N; i++) {
        told[4 + i] = PCR_WRAPPED ? unwrapped(measured->q[i], due[4 + i]) : measured->q[i];
    }
    const oddity about_angles = odd_angles(controller, told + 4), about_tip = odd_tip(controller, told, due);
    int tip = about_tip == ODD_NOT, angles = about_angles == ODD_NOT, moved = 0;
    controller->without = isnan(told[0]) ? controller->without + 1 : 0;
    /* That there is no tip between two pictures is no news. */
    const int is_due = !(controller->without > 0 && controller->without < PCR_EVERY);
    *doubts = 0;
    if (controller->first && ((is_due && about_tip == ODD_UNITS) || about_angles == ODD_UNITS)) {
        return PCR_FIRST_MEASUREMENT;
    }
    if (angles) {
        double surprise = 0.0;
        for (int i = 0; i < PCR_N; i++) {
            const double away = fabs(told[4 + i] - due[4 + i]);
            surprise = away > surprise ? away : surprise;
        }
        believed(&controller->encoders, surprise);
    } else {
        angles = refused(&controller->encoders, told + 4, PCR_N, turn) && about_angles != ODD_UNITS;
        for (int i = 0; i < PCR_N; i++) {
            angles = angles && controller->parameters.angle_lower[i] - PCR_ANGLE_STEP <= told[4 + i]
                     && told[4 + i] <= controller->parameters.angle_upper[i] + PCR_ANGLE_STEP;
        }
        if (angles) {
            believed(&controller->encoders, turn);
        }
        *doubts |= angles ? PCR_DOUBT_ANGLES_INSIST : PCR_DOUBT_ANGLES;
    }
    if (!is_due) {
        tip = 0;
    } else if (tip) {
        believed(&controller->tip, hypot(told[0] - due[0], told[1] - due[1]));
    } else {
        const double before[2] = {controller->tip.last[0], controller->tip.last[1]};
        const int known = controller->tip.known;
        tip = refused(&controller->tip, told, 2, 2.0 * near_tip(controller)) && known
              && !too_far(controller, told, 0.0);
        if (tip) {
            moved = 1;
            velocity[0] = (told[0] - before[0]) / (PCR_EVERY * PCR_PERIOD);
            velocity[1] = (told[1] - before[1]) / (PCR_EVERY * PCR_PERIOD);
            believed(&controller->tip, near_tip(controller));
        }
        *doubts |= tip ? PCR_DOUBT_TIP_INSISTS : PCR_DOUBT_TIP;
    }
    controller->first = 0;
    memcpy(controller->before, angles ? told + 4 : due + 4, sizeof controller->before);
    if (!PCR_OBSERVER) {
        if (tip) {
            memcpy(expected, told, 4 * sizeof *expected);
        }
        if (angles) {
            memcpy(expected + 4, told + 4, PCR_N * sizeof *expected);
        }
    }
    if (moved) {
        memcpy(expected + 2, velocity, sizeof velocity);
        if (PCR_OBSERVER) {
            memcpy(expected, told, 2 * sizeof *expected);
            expected[PCR_STATES] = expected[PCR_STATES + 1] = 0.0; /* no force is suspected */
        }
        pcr_past_clear(controller);
    } else if (PCR_PAST > 0 && tip) {
        const double *gain = controller->parameters.observer_gain, away[2] = {told[0] - due[0], told[1] - due[1]};
        double change[6];
        for (int i = 0; i < 6; i++) {
            change[i] = gain[i] * away[0] + gain[6 + i] * away[1];
        }
        pcr_past_correct(controller, change);
        for (int i = 0; i < 6; i++) {
            expected[i < 4 ? i : PCR_STATES + i - 4] += change[i];
        }
        tip = 0; /* it is done with */
    }
    memcpy(given, tip ? told : expected, 2 * sizeof *given);
    memcpy(given + 2, angles ? told + 4 : expected + 4, PCR_N * sizeof *given);
    return PCR_OK;
}
