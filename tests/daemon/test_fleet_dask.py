"""A fleet on a Dask cluster of two workers, one of them killed in the middle, is the fleet trained alone."""

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from sisters import few_sensors, write_configuration, write_sister

from config.recordings.machine_map import MachineFiles
from daemon.workbench.thermal.fleet import FleetError, fleet_executor, train_fleet

pytest.importorskip("distributed", reason="Dask is not installed here (toolpoint[dask])")


@pytest.fixture(scope="module")
def machines(tmp_path_factory: pytest.TempPathFactory) -> list[MachineFiles]:
    """Return machines, more than workers: every recording stands for two of them."""
    folder, sensors = tmp_path_factory.mktemp("fleet"), few_sensors(8)
    configuration = write_configuration(folder / "toolpoint.yaml", sensors)
    read = {number: tuple(write_sister(folder, number, 2, sensors, hours=2.0)) for number in (1, 2, 3)}
    return [
        MachineFiles(name=f"{number}{twin}", recordings=paths, configuration=configuration, map=None)
        for number, paths in read.items()
        for twin in "ab"
    ]


@pytest.mark.slow
def test_a_worker_that_is_killed_in_the_middle_changes_nothing(machines: list[MachineFiles]) -> None:
    from distributed import LocalCluster

    killed: list[int] = []
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:

        def kill_one(what: str, done: int, total: int) -> None:
            """Kill a worker when the first machine is there: what it holds and does is lost."""
            if what == "machines" and done == 1 and not killed:
                pid = cluster.workers[0].pid
                os.kill(pid, signal.SIGKILL)
                killed.append(pid)

        with fleet_executor(1, cluster.scheduler_address) as executor:
            shared = train_fleet(machines, "mill", None, executor, kill_one)
    with fleet_executor(1, None) as executor:
        alone = train_fleet(machines, "mill", None, executor)
    assert len(killed) == 1 and not Path(f"/proc/{killed[0]}").exists()
    assert [one.machine for one in shared.summaries] == [one.machine for one in alone.summaries]
    assert np.allclose(shared.machine_type.models, alone.machine_type.models, atol=1e-5)
    assert [one.how for one in shared.left_out] == [one.how for one in alone.left_out]


def test_a_cluster_whose_workers_end_or_whose_scheduler_goes_is_said() -> None:
    from distributed import LocalCluster

    from daemon.workbench.thermal.fleet import mapped

    with (
        LocalCluster(n_workers=1, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
        fleet_executor(1, cluster.scheduler_address) as executor,
    ):
        with pytest.raises(FleetError, match=r"4 Dask workers ended, .* while machine 1 of 1 .* more memory"):
            mapped(executor, os._exit, [1], lambda done: None)
        with pytest.raises(FleetError, match="connection to the Dask scheduler was lost while machine 2 of 3"):
            mapped(executor, time.sleep, [0.1, 5.0, 5.0], lambda done: cluster.close())
