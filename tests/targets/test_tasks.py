"""Work on several cores and machines: results in order, progress, and failures that name their photograph."""

import multiprocessing
import threading
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import cv2
import numpy as np
import pytest
import torch

from diffproj.targets import finders, tasks
from diffproj.targets.chessboard import Chessboard
from diffproj.targets.detection import detect
from diffproj.targets.tasks import results_of


@pytest.fixture
def folder(tmp_path):
    """Four photographs of a drawn board, each a little elsewhere."""
    squares = np.indices((7, 10)).sum(axis=0) % 2
    for number in range(4):
        image = np.full((200, 280), 255, dtype=np.uint8)
        image[20 : 20 + 140, 20 + 5 * number : 220 + 5 * number] = np.kron(squares, np.ones((20, 20))) * 255
        assert cv2.imwrite(str(tmp_path / f"{number}.png"), image)
    return tmp_path


def test_threads_give_what_one_after_the_other_gives(folder):
    board, calls = Chessboard(9, 6), []
    alone = detect(folder, board)
    with ThreadPoolExecutor(3) as pool:
        together = detect(folder, board, lambda done, total: calls.append((done, total)), executor=pool)
    assert together.names == alone.names
    assert torch.equal(together.pixels, alone.pixels)
    assert calls == [(1, 4), (2, 4), (3, 4), (4, 4)]


@pytest.mark.slow
def test_processes_give_what_one_after_the_other_gives(folder):
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        together = detect(folder, Chessboard(9, 6), executor=pool)
    assert torch.equal(together.pixels, detect(folder, Chessboard(9, 6)).pixels)


@pytest.mark.slow
def test_a_dask_cluster_gives_what_one_after_the_other_gives(folder):
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        together = detect(folder, Chessboard(9, 6), executor=client.get_executor())
    assert torch.equal(together.pixels, detect(folder, Chessboard(9, 6)).pixels)


def test_results_are_in_order_whoever_is_first():
    """The later, the sooner done."""
    gates = [threading.Event() for _ in range(4)]
    gates[3].set()

    def work(number):
        gates[number].wait(10)
        if number:
            gates[number - 1].set()
        return number * number

    with ThreadPoolExecutor(4) as pool:
        assert results_of(work, range(4), pool) == [0, 1, 4, 9]


def test_a_failure_stops_the_rest(monkeypatch):
    monkeypatch.setattr(tasks, "AHEAD", 2)
    done = []

    def work(number):
        if number == 3:
            raise ValueError("number 3")
        done.append(number)

    with ThreadPoolExecutor(1) as pool, pytest.raises(ValueError, match="number 3"):
        results_of(work, range(100), pool)
    assert len(done) < 8


def test_an_exception_names_its_photograph(folder, monkeypatch):
    def fails(image, board):
        raise cv2.error("out of memory")

    monkeypatch.setattr(finders, "find_pattern", fails)
    with ThreadPoolExecutor(2) as pool, pytest.raises(RuntimeError, match=r"\d\.png: error while searching it: out of"):
        detect(folder, Chessboard(9, 6), executor=pool)
    monkeypatch.undo()
    (folder / "1.png").write_bytes(b"text")
    with ThreadPoolExecutor(2) as pool, pytest.raises(ValueError, match=r"1\.png: want an image"):
        detect(folder, Chessboard(9, 6), executor=pool)


@pytest.mark.plain
def test_no_executor():
    with pytest.raises(TypeError, match=r"executor: want a concurrent\.futures\.Executor, got int"):
        detect(np.zeros((100, 100), np.uint8), Chessboard(9, 6), executor=4)
    with pytest.raises(TypeError, match="executor: want .*, got the class ThreadPoolExecutor"):
        detect(np.zeros((100, 100), np.uint8), Chessboard(9, 6), executor=ThreadPoolExecutor)
