"""A controller changed in Python: what the input weight does on the figure of eight."""

from dataclasses import replace

from pcr_mpc import load_scene, load_tuning, make_controller, shipped, simulate

scene = replace(load_scene(shipped("lemniscate")), duration=2.0)
tuning = load_tuning(shipped("default", "tuning"))
for weight in (1e-3, 1e-2, 1e-1):
    controller = make_controller(scene, replace(tuning, input_weight=weight))
    run = simulate(scene, scene.make_plant(), controller)
    print(f"input weight {weight:g}: {run.summary()['rms_after_1s_mm']:.5f} mm RMS after 1 s")
