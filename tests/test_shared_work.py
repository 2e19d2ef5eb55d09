"""Clusters of a table on several processes: the results of one, in the same order."""

import subprocess
import sys
from multiprocessing import current_process

import numpy as np
import pandas as pd
import pytest

import perrin
from perrin.run import batches_of, measure, shared_work
from perrin.run.workers import Work, dask_client, one_thread


def test_work_is_done_on_one_thread_and_the_number_before_comes_back(monkeypatch):
    """The libraries are searched once, and again after an import, which may load another one."""
    pools = pytest.importorskip("threadpoolctl")
    pytest.importorskip("scipy.linalg")
    searched, search = [], pools.ThreadpoolController.__init__

    def counted(controller):
        searched.append(1)
        search(controller)

    def threads(_=None):
        return [one["num_threads"] for one in pools.threadpool_info()]

    with pools.threadpool_limits(2):
        before = threads()
        assert max(before) == 2
        assert set(one_thread(threads, 0)) == {1}
        assert threads() == before
    monkeypatch.setattr(pools.ThreadpoolController, "__init__", counted)
    one_thread(float, 0)
    assert searched == []
    monkeypatch.setitem(sys.modules, "another", pools)
    one_thread(float, 0)
    assert searched == [1]


@pytest.fixture(scope="module")
def scheduler():
    """Start a scheduler and two workers in this process, which are reached by TCP."""
    distributed = pytest.importorskip("distributed")
    settings = {"protocol": "tcp://", "host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, **settings
    ) as cluster:
        yield cluster.scheduler_address


def tetrahedra(count, n_frames):
    """Return a table of labelled tetrahedra; the last cluster is too short to be measured."""
    body, parts = perrin.Cluster.touching(4, 2.45), []
    for c in range(count):
        frames = n_frames if c < count - 1 else 2
        truth = perrin.simulate_motion(
            body, D_R=5e-3, D_T=0.04, dt=0.7, n_frames=frames, rng=[7, c]
        )
        x = perrin.add_noise(truth.positions(), sigma=0.03, rng=[8, c])
        table = perrin.positions_table(x + 20.0 * c).assign(cluster=c)
        parts.append(table.assign(particle=table["particle"] + 4 * c))
    return pd.concat(parts, ignore_index=True)


def test_a_dask_cluster_gives_the_results_of_one_process(scheduler, monkeypatch):
    """Every number, remark and failure is the same to the last bit, in the same order."""
    monkeypatch.setattr(measure, "clusters_together", lambda count, poses: 2)
    table = tetrahedra(4, 15)
    alone = perrin.analyze(table, dt=0.7)
    shared = perrin.analyze(table, dt=0.7, scheduler=scheduler)
    assert [one.cluster for one in shared.clusters] == [0, 1, 2]
    assert shared.warnings == alone.warnings
    ours, theirs = alone.to_dict(), shared.to_dict()
    for entry in (ours, theirs):
        entry.pop("settings", None)
    assert ours == theirs
    for one, other in zip(alone.clusters, shared.clusters, strict=True):
        np.testing.assert_array_equal(one.motion.rotation, other.motion.rotation)


def test_results_come_in_the_order_of_the_batches(scheduler):
    """Also where a later batch is finished first."""
    batches = list(batches_of(range(7), size=2))
    with shared_work(Work(scheduler=scheduler)) as in_order:
        assert list(in_order(sum, batches)) == [1, 5, 9, 6]


def test_arguments_of_the_work_are_checked_before_the_table_is_read():
    """A scheduler and processes of this machine exclude each other."""
    with pytest.raises(ValueError, match="workers: expected processes of this machine"):
        perrin.analyze("absent.csv", dt=1.0, workers=2, scheduler="tcp://127.0.0.1:9")


def test_a_worker_that_imports_its_script_starts_no_workers(monkeypatch):
    monkeypatch.setattr(current_process(), "_inheriting", True, raising=False)
    with pytest.raises(SystemExit), dask_client(1, None):
        pass


@pytest.mark.parametrize("guarded", [True, False])
def test_workers_of_a_script_without_guard_are_explained(tmp_path, monkeypatch, guarded):
    pytest.importorskip("distributed")
    script = tmp_path / "mine.py"
    script.write_text('if __name__ == "__main__": main()' if guarded else "main()")

    def fails(**_):
        raise RuntimeError("Nanny failed to start.")

    monkeypatch.setattr("distributed.LocalCluster", fails)
    monkeypatch.setattr(sys.modules["__main__"], "__file__", str(script), raising=False)
    expected = "Nanny failed" if guarded else "processes that import mine.py"
    with pytest.raises(RuntimeError, match=expected), dask_client(1, None):
        pass


def test_a_script_that_workers_would_run_again_ends_with_one_message(tmp_path, request):
    """Every process imports the script: without the guard it would start processes itself."""
    if not request.config.getoption("--long"):
        pytest.skip("--long: starts processes")
    script = tmp_path / "mine.py"
    script.write_text(
        "from perrin.run.workers import dask_client\nwith dask_client(1, None): pass\n"
    )
    ended = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert ended.stderr.count("Traceback") == 1
    message = "workers=1 starts processes that import mine.py"
    assert ended.stderr.partition("RuntimeError: ")[2].startswith(message)
    assert ended.stderr.endswith('if __name__ == "__main__":\n    main()\n')
