"""What one thread of a card does, and how the threads of a launch share the queries: a path each."""

from functools import cache
from types import SimpleNamespace

import numba
import numpy as np
from numba import cuda

from illumgrid.constants import LOST
from illumgrid_cuda.source import functions

THREADS = 128
"""In a block."""


def _tasks(loop):
    """The three tasks of a thread, in terms of the functions of the path loop."""
    begin, shells_around, stream, place_in_sweep = loop.begin, loop.shells_around, loop.stream, loop.place_in_sweep
    walk, moments = loop.walk, loop.moments

    def begin_one(i, scene, cache, asked, seed, start, face, within, place, key, paths, count):
        """Where the paths of query i begin; `paths` stays 0 for a hole."""
        point, normal = asked.point, asked.normal
        x, n = (point[i, 0], point[i, 1], point[i, 2]), (normal[i, 0], normal[i, 1], normal[i, 2])
        if n[0] == 0.0 and n[1] == 0.0 and n[2] == 0.0:
            return
        own = np.int64(asked.target[i])
        x, at = begin(scene, own, x, n)
        around = shells_around(scene, asked.level[i], x, n, own)
        if at == LOST or around < 0:
            return
        within[i] = around
        start[i, 0], start[i, 1], start[i, 2], face[i] = x[0], x[1], x[2], at
        key[i], place[i], paths[i] = stream(seed, asked.id[i]), place_in_sweep(cache, asked.level[i]), count

    def walk_one(
        i, scene, cache, asked, start, face, within, place, key, paths, first, bounces, throughput, own_worth, worth
    ):
        """Path i of all queries in turn."""
        q, k = i // worth.shape[1], i % worth.shape[1]
        if paths[q] == 0:
            return
        x = (start[q, 0], start[q, 1], start[q, 2])
        n = (asked.normal[q, 0], asked.normal[q, 1], asked.normal[q, 2])
        own, number = np.int64(asked.target[q]), np.uint64(first + k)
        walk(
            scene, cache, place[q], key[q], number, bounces, asked.level[q], own, face[q], x, n, within[q],
            throughput, own_worth,
        )  # fmt: skip
        for channel in range(own_worth.shape[0]):
            worth[q, k, channel] = own_worth[channel]

    def judge_one(i, scene, paths, first, worth, mean, m2):
        """Mean and m2 of channel and query number i."""
        q, channel = i // worth.shape[2], i % worth.shape[2]
        if paths[q] > 0:
            found, off = moments(worth[q], first, scene.usual[channel], scene.lamplight[channel], channel)
            mean[q, channel], m2[q, channel] = np.pi * found, np.pi * np.pi * off

    return (loop.compiled(task) for task in (begin_one, walk_one, judge_one))


@cache
def launchers(device, channels):
    """The three launches, each called with the number of its threads and the arguments of its task."""
    return _on_processor() if device == "processor" else _on_card(channels)


def _on_card(channels):
    begin_one, walk_one, judge_one = _tasks(functions("card"))

    @cuda.jit
    def begin(scene, cache, asked, seed, start, face, within, place, key, paths, count):
        i = cuda.grid(1)
        if i < paths.shape[0]:
            begin_one(i, scene, cache, asked, seed, start, face, within, place, key, paths, count)

    @cuda.jit
    def walk(scene, cache, asked, start, face, within, place, key, paths, first, bounces, worth):
        throughput = cuda.local.array(channels, np.float64)
        own_worth = cuda.local.array(channels, np.float64)
        i = cuda.grid(1)
        if i < worth.shape[0] * worth.shape[1]:
            walk_one(
                i, scene, cache, asked, start, face, within, place, key, paths, first, bounces,
                throughput, own_worth, worth,
            )  # fmt: skip

    @cuda.jit
    def judge(scene, paths, first, worth, mean, m2):
        i = cuda.grid(1)
        if i < worth.shape[0] * worth.shape[2]:
            judge_one(i, scene, paths, first, worth, mean, m2)

    def launched(kernel):
        return lambda count, *arguments: kernel[-(-count // THREADS), THREADS](*arguments)

    return SimpleNamespace(
        begin=launched(begin), walk=launched(walk), judge=launched(judge), kernels=(begin, walk, judge)
    )


@cache
def _on_processor():
    begin_one, walk_one, judge_one = _tasks(functions("processor"))
    compiled = numba.njit(nogil=True, error_model="numpy")

    @compiled
    def begin(count, scene, cache, asked, seed, start, face, within, place, key, paths, many):
        for i in range(count):
            begin_one(i, scene, cache, asked, seed, start, face, within, place, key, paths, many)

    @compiled
    def walk(count, scene, cache, asked, start, face, within, place, key, paths, first, bounces, worth):
        throughput, own_worth = np.empty(worth.shape[2]), np.empty(worth.shape[2])
        for i in range(count):
            walk_one(
                i, scene, cache, asked, start, face, within, place, key, paths, first, bounces,
                throughput, own_worth, worth,
            )  # fmt: skip

    @compiled
    def judge(count, scene, paths, first, worth, mean, m2):
        for i in range(count):
            judge_one(i, scene, paths, first, worth, mean, m2)

    return SimpleNamespace(begin=begin, walk=walk, judge=judge)
