"""`tricap settings [GROUP]`: all settings of a run, for `--set` and take.toml."""

import argparse
import dataclasses
import json
from typing import Any

from ..foundation.errors import InputError
from ..foundation.progress import Monitor
from ..foundation.settings import nearest_name
from ..run.settings import SETTINGS


def run(args: argparse.Namespace, monitor: Monitor) -> list[str]:
    """Describe every setting, or those of a group: its name, default, limits and purpose.

    Raises:
        InputError: there is no such group.
    """
    if args.group is not None and args.group not in SETTINGS:
        raise InputError(f"There is no group of settings “{args.group}”.{nearest_name(args.group, list(SETTINGS))}")
    groups = SETTINGS if args.group is None else {args.group: SETTINGS[args.group]}
    return [line for name, group in groups.items() for knob in dataclasses.fields(group) for line in _described(name, knob)]


def _described(group: str, knob: "dataclasses.Field[Any]") -> list[str]:
    about = knob.metadata
    low, high, limits = about["low"], about["high"], " or ".join(about["choices"])
    if low is not None or high is not None:
        limits = f"{low:g} to {high:g}" if None not in (low, high) else f"from {low:g}" if high is None else f"up to {high:g}"
    unit = f" {about['unit']}" if about["unit"] else ""
    value = knob.default if isinstance(knob.default, str) else json.dumps(knob.default)
    return [f"{group}.{knob.name}={value}{unit}" + (f"   ({limits})" if limits else ""), f"    {about['about']}"]
