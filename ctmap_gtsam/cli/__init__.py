"""The `ctmap` command. Commands hold no logic: they read settings, call one function and print what it gives."""

from __future__ import annotations

from ctmap_gtsam.runtime.threads import limit_library_threads


def main() -> None:
    """Run `ctmap` on the arguments of this process."""
    limit_library_threads()
    from ctmap_gtsam.cli.app import app

    app()
