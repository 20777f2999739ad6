"""A person changes the policy at work positioning in the daemon's configuration."""

from pathlib import Path

import yaml


def change_policy(path: Path, *, zero_first: bool) -> None:
    """Write the configuration anew with this policy; the daemon reads it when it is started."""
    content = yaml.safe_load(path.read_text("utf-8"))
    content["compensation"]["reference"]["policy"] = "zero_first" if zero_first else "bumpless"
    path.write_text(yaml.safe_dump(content, sort_keys=False, width=120), encoding="utf-8")
