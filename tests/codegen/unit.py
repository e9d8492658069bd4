"""One instance of a functional mock-up unit in FMPy."""

import fmpy
import fmpy.fmi2
import fmpy.fmi3
import numpy as np

MEASURED = ["p_x", "p_y", "v_x", "v_y", "q[0]", "q[1]"]
RATES = ["u[0]", "u[1]"]
PERIOD = 0.01


class Unit:
    """One instance; what it logs is in ``said``."""

    def __init__(self, path, folder, start=0.0, values=None):
        about = fmpy.read_model_description(str(path))
        self.two, self.said = about.fmiVersion == "2.0", []
        self.at = {variable.name: variable.valueReference for variable in about.modelVariables}
        kind = fmpy.fmi2.FMU2Slave if self.two else fmpy.fmi3.FMU3Slave
        self.slave = kind(modelIdentifier=about.coSimulation.modelIdentifier, unzipDirectory=str(folder),
                          instanceName="one", guid=about.guid or about.instantiationToken)  # fmt: skip
        if self.two:
            self._log = fmpy.fmi2.fmi2CallbackLoggerTYPE(self._hear)
            calls = fmpy.fmi2.fmi2CallbackFunctions()
            calls.logger = self._log
            calls.allocateMemory = fmpy.fmi2.fmi2CallbackAllocateMemoryTYPE(fmpy.calloc)
            calls.freeMemory = fmpy.fmi2.fmi2CallbackFreeMemoryTYPE(fmpy.free)
            self.slave.instantiate(callbacks=calls)
            self.slave.setupExperiment(startTime=start)
            self.set(values or {})
            self.slave.enterInitializationMode()
        else:
            self.slave.instantiate(logMessage=lambda _, status, kind, text: self.said.append(text.decode()))
            self.set(values or {})
            self.slave.enterInitializationMode(startTime=start)
        self.slave.exitInitializationMode()

    def _hear(self, _, name, status, kind, text):
        self.said.append(text.decode())

    def state(self, what, *words):
        """Call get, set, free, serialize or deserialize."""
        name = f"{what}FMU{'state' if self.two else 'State'}"
        return getattr(self.slave, name.replace("des", "deS") if self.two else name)(*words)

    def get(self, names):
        at = [self.at[name] for name in names]
        return np.array(self.slave.getReal(at) if self.two else self.slave.getFloat64(at))

    def whole(self, name):
        at = [self.at[name]]
        return (self.slave.getInteger(at) if self.two else self.slave.getInt32(at))[0]

    def set(self, values):
        at, values = [self.at[name] for name in values], [float(value) for value in values.values()]
        if values:
            self.slave.setReal(at, values) if self.two else self.slave.setFloat64(at, values)

    def step(self, time, step):
        return self.slave.doStep(currentCommunicationPoint=time, communicationStepSize=step)

    def decide(self, k, x):
        self.set({name: value for name, value in zip(MEASURED, x, strict=True) if name in self.at})
        self.step(k * PERIOD, PERIOD)
        return self.get(RATES)

    def move(self, k, u):
        self.set(dict(zip(RATES, u, strict=True)))
        self.step(k * PERIOD, PERIOD)
        return self.get(MEASURED)
