"""Plant and controller as functional mock-up units, coupled by FMPy: the run of `pcr-mpc track`, through FMI."""

from pathlib import Path
from shutil import rmtree

import numpy as np
from fmpy import extract, instantiate_fmu, read_model_description

from pcr_mpc import load_scene, shipped
from pcr_mpc.cli import main

scene = load_scene(shipped("lemniscate", "scene"))
units, folders = {}, []
for part in ("plant", "controller"):
    file = Path("build") / f"pcr_{scene.name}_{part}.fmu"
    main(["fmu", "lemniscate", "--part", part, "--out", str(file)])
    about = read_model_description(str(file))
    folders.append(extract(str(file)))
    unit = instantiate_fmu(folders[-1], about, fmi_type="CoSimulation")
    unit.setupExperiment(startTime=0.0)
    unit.enterInitializationMode()
    unit.exitInitializationMode()
    units[part] = unit, {variable.name: variable.valueReference for variable in about.modelVariables}
plant, of_plant = units["plant"]
controller, of_controller = units["controller"]
measured, rates = ["p_x", "p_y", "q[0]", "q[1]"], ["u[0]", "u[1]"]


def carry(names, source, at_source, target, at_target):
    """Copy variables from one unit to the other."""
    target.setReal([at_target[name] for name in names], source.getReal([at_source[name] for name in names]))


# The controller measures, decides, and only then the plant moves: a period of delay less than if both stepped at once.
period, step = scene.period, 0.001
tips = [plant.getReal([of_plant["p_x"], of_plant["p_y"]])]
for k in range(scene.n_periods):
    carry(measured, plant, of_plant, controller, of_controller)
    controller.doStep(k * period, period)
    carry(rates, controller, of_controller, plant, of_plant)
    for j in range(round(period / step)):
        plant.doStep(k * period + j * step, step)
        tips.append(plant.getReal([of_plant["p_x"], of_plant["p_y"]]))
error = np.array(tips) - scene.trajectory(step * np.arange(len(tips)))[:, 0]
print(f"RMS error of the tip {1e3 * np.sqrt(np.mean(np.sum(error**2, axis=1))):.12f} mm")
for (unit, _), folder in zip(units.values(), folders, strict=True):
    unit.terminate()
    unit.freeInstance()
    rmtree(folder)
