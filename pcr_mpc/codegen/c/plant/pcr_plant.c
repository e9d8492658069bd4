/* The plant: one time step as one graph, in one Newton iteration or two. */
#include <math.h>
#include <stddef.h>
#include <string.h>

#include "pcr_graphs.h"
#include "pcr_parts.h"

/* Let the rods of such numbers follow from `record` to where the plant is. Returns 0 if they did. */
static int bring(pcr_plant *plant, const double *numbers, double *record)
{
    double result[PCR_RESULT];
    pcr_room room;
    room.arg = plant->arg;
    room.res = plant->res;
    room.iw = plant->iw;
    room.w = plant->w;
    if (pcr_follow(&pcr_model_rods, numbers, plant->x, plant->x + 4, PCR_CLOSE, record, result, &room)) {
        return 1;
    }
    memcpy(plant->memory, record, PCR_PLANT_START * sizeof *record);
    memcpy(plant->memory + PCR_PLANT_START, result, 2 * sizeof *result);
    return 0;
}

pcr_result pcr_plant_init(pcr_plant *plant, const pcr_pose *pose)
{
    if (plant == NULL) {
        return PCR_ARGUMENT;
    }
    memset(plant, 0, sizeof *plant);
    const pcr_pose *at = pose == NULL ? &pcr_scene_pose : pose;
    double record[PCR_RECORD];
    memcpy(plant->memory, pcr_scene_memory, sizeof plant->memory);
    memcpy(plant->numbers, pcr_scene_plant_numbers, sizeof plant->numbers);
    memcpy(plant->x, at->p, sizeof at->p);
    memcpy(plant->x + 4, at->q, sizeof at->q);
    pcr_drive_start(&plant->drive, at->q);
    plant->tip_mass = plant->numbers[PCR_PLANT_TIP_MASS];
    if (pose != NULL) {
        for (int i = 0; i < PCR_STATES; i++) {
            if (!isfinite(plant->x[i])) {
                return PCR_ARGUMENT;
            }
        }
        if (!PCR_PLANT_AS_MODEL) {
            return PCR_NOT_HERE;
        }
        memcpy(record, pcr_scene_record, sizeof record);
        if (bring(plant, plant->numbers, record)) {
            return PCR_OUT_OF_REACH;
        }
    }
    plant->started = 1;
    return PCR_OK;
}

pcr_result pcr_plant_set_numbers(pcr_plant *plant, const double *numbers)
{
    double record[PCR_RECORD] = {0.0}, all[PCR_PLANT_NUMBERS];
    if (pcr_plant_status(plant) != PCR_OK) {
        return PCR_NOT_STARTED;
    }
    if (!PCR_PLANT_AS_MODEL) {
        return PCR_NOT_HERE;
    }
    if (numbers == NULL || pcr_plant_refused_number(numbers) >= 0) {
        return PCR_ARGUMENT;
    }
    memcpy(all, numbers, sizeof all);
    all[PCR_PLANT_TIP_MASS] += plant->payload;
    memcpy(record, plant->memory, PCR_PLANT_START * sizeof *record);
    if (bring(plant, all, record)) {
        return PCR_OUT_OF_REACH;
    }
    plant->tip_mass = numbers[PCR_PLANT_TIP_MASS];
    memcpy(plant->numbers, all, sizeof all);
    return PCR_OK;
}

pcr_result pcr_plant_status(const pcr_plant *plant)
{
    return plant != NULL && plant->started ? PCR_OK : PCR_NOT_STARTED;
}

pcr_result pcr_plant_step(pcr_plant *plant, const double *u, const double *force)
{
    double given[PCR_N + 2], end[PCR_STATES], verdict[5];
    if (pcr_plant_status(plant) != PCR_OK) {
        return PCR_NOT_STARTED;
    }
    if (u == NULL) {
        return PCR_ARGUMENT;
    }
    for (int i = 0; i < PCR_N + 2; i++) {
        given[i] = i < PCR_N ? u[i] : force == NULL ? 0.0 : force[i - PCR_N];
        if (!isfinite(given[i])) {
            return PCR_ARGUMENT;
        }
    }
    const pcr_drive before = plant->drive;
    if (PCR_MOTORS) {
        double rates[PCR_N];
        pcr_drive_turn(&plant->drive, plant->numbers, plant->x + 4, given, rates);
        memcpy(given, rates, sizeof rates);
    }
    for (int corrections = 1; corrections <= 2; corrections++) {
        plant->arg[0] = plant->memory;
        plant->arg[1] = plant->x;
        plant->arg[2] = given;
        plant->arg[3] = plant->numbers;
        plant->res[0] = plant->next;
        plant->res[1] = end;
        plant->res[2] = verdict;
        (corrections == 1 ? pcr_graph_plant_once : pcr_graph_plant_twice)(plant->arg, plant->res, plant->iw, plant->w);
        int good = 1;
        for (int i = 0; i < 5; i++) {
            good = good && verdict[i] <= pcr_plant_limits[i];
        }
        for (int i = 0; i < PCR_STATES; i++) {
            good = good && isfinite(end[i]);
        }
        if (good) {
            memcpy(plant->memory, plant->next, sizeof plant->memory);
            memcpy(plant->x, end, sizeof end);
            plant->corrections = corrections;
            return PCR_OK;
        }
        if (!(verdict[0] <= PCR_ROUGH)) {
            break; /* lost, not just unfinished */
        }
    }
    plant->drive = before;
    return PCR_OUT_OF_REACH;
}

pcr_result pcr_plant_carry(pcr_plant *plant, double payload)
{
    if (pcr_plant_status(plant) != PCR_OK) {
        return PCR_NOT_STARTED;
    }
    if (!(payload >= 0.0 && isfinite(payload)) || !(PCR_PLANT_MASSLESS || PCR_PLANT_CONSTANT)) {
        return PCR_ARGUMENT;
    }
    /* M of the tip's motion [a, b; b, d], before and after; what is picked up was at rest, and momentum stays. */
    double *mass = plant->numbers + PCR_PLANT_TIP_MASS, a = *mass, b = 0.0, d = *mass;
    const double before = plant->payload, change = payload - before;
    *mass = plant->tip_mass + payload;
    if (PCR_PLANT_CONSTANT) {
        double *matrix = plant->memory + PCR_PLANT_START + 2;
        a = matrix[0];
        b = matrix[1];
        d = matrix[3 + PCR_N];
        matrix[0] += change;
        matrix[3 + PCR_N] += change;
    }
    if (change > 0.0) {
        const double px = a * plant->x[2] + b * plant->x[3], py = b * plant->x[2] + d * plant->x[3];
        const double determinant = (a + change) * (d + change) - b * b;
        plant->x[2] = ((d + change) * px - b * py) / determinant;
        plant->x[3] = ((a + change) * py - b * px) / determinant;
    }
    plant->payload = payload;
    return PCR_OK;
}

unsigned long pcr_plant_size(void)
{
    return sizeof(pcr_plant);
}
