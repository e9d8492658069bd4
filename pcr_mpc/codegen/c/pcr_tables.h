/* The scene's numbers, which were written beside this file. */
#ifndef PCR_TABLES_H
#define PCR_TABLES_H

#include "pcr.h"

#ifdef __cplusplus
extern "C" {
#endif

extern const pcr_parameters pcr_scene_parameters;
extern const pcr_pose pcr_scene_pose;
extern const double pcr_scene_record[PCR_RECORD];         /* of the model's rods in that pose */
extern const double pcr_scene_target_record[PCR_TARGET];  /* of the motor target's */
extern const double pcr_scene_watch_record[PCR_WATCH_RECORD]; /* of those whose limits are watched */
extern const double pcr_scene_watch_result[6 + 2 * PCR_N];    /* their F, K, G */
extern const double pcr_scene_target_numbers[PCR_TARGET_NUMBERS], pcr_scene_watch_numbers[PCR_WATCH_NUMBERS];
/* Where their numbers are among those of the model; -1: it does not know them. */
extern const int pcr_target_places[PCR_TARGET_NUMBERS], pcr_watch_places[PCR_WATCH_NUMBERS];
extern const double pcr_scene_model[PCR_MODEL];           /* linear model of the robot at rest there */
extern const double pcr_scene_mass[(2 + PCR_N) * (2 + PCR_N)];
extern const double pcr_scene_memory[PCR_PLANT_MEMORY];   /* of the plant there */
extern const double pcr_plant_limits[5];                  /* of a verdict with which the rods have followed */
extern const int pcr_in_places[PCR_INS], pcr_out_places[PCR_OUTS]; /* where inputs and outputs of the graph lie */
extern const double pcr_scene_plant_numbers[PCR_PLANT_NUMBERS];
/* Least and greatest of each that a robot may have: of the controller's model, and of the plant. */
extern const double pcr_number_ranges[PCR_NUMBERS][2], pcr_plant_number_ranges[PCR_PLANT_NUMBERS][2];
/* State at the start, and at the ends of all periods, and the force that the rods carry there. */
extern const double pcr_scene_reference[PCR_REFERENCE_ROWS + 1][PCR_STATES + 2];
extern const double pcr_scene_end[PCR_ROW];               /* held beyond the end of the reference */
extern const double pcr_scene_payloads[PCR_PAYLOAD_ROWS];
extern const double pcr_critical_rows[PCR_CRITICAL], pcr_critical_loads[PCR_CRITICAL];
extern const double pcr_thickness[PCR_N];                  /* half thickness of each rod over its length */
extern const int pcr_kind_rows[PCR_POSE_KINDS + 1];          /* rows of each kind of limits on poses */
extern const int pcr_kind_bits[PCR_POSE_KINDS + 1];          /* which bit of pcr_output.active is its */
extern const pcr_qp_shape pcr_rates_shape, pcr_limited_shapes[1 << PCR_POSE_KINDS];
extern const int pcr_limited_places[1 << PCR_POSE_KINDS];     /* of each combination in pcr_limited.last */
extern const int pcr_rates_starts[PCR_INPUTS + 1], pcr_rates_rows[PCR_RATES_A];
extern const double pcr_rates_values[PCR_RATES_A];

#ifdef __cplusplus
}
#endif

#endif
