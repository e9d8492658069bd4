"""What figures of time were measured on."""

from __future__ import annotations

import gc
import os
import platform
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any


def machine() -> dict[str, Any]:
    """Computer, and how busy it is."""
    return {
        "platform": platform.platform(),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "usable_cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "clock_ns": 1e9 * time.get_clock_info("perf_counter").resolution,
        "switch_interval_us": 1e6 * sys.getswitchinterval(),
        "gc_threshold": gc.get_threshold(),
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def versions() -> dict[str, str]:
    """Versions of what does the arithmetic."""
    return {
        "python": platform.python_version(),
        **{name: version(name) for name in ("casadi", "numpy", "scipy", "osqp", "daqp")},
    }
