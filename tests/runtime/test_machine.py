import dataclasses
import platform
import resource

import numpy as np
import pytest
import torch

from polarnet.runtime import machine as runtime
from polarnet.runtime.machine import (
    RuntimeConfig,
    device_of,
    generator_for,
    keep_freed_memory,
    precision_on,
    seed_for,
)

RUNTIME = RuntimeConfig(device="cpu", threads=1, workers=1)


def test_a_seed_depends_on_each_of_its_three_parts_and_on_nothing_else():
    assert seed_for(1, "coffee", "motion") == seed_for(1, "coffee", "motion")
    assert len({seed_for(1, "coffee", "motion"), seed_for(2, "coffee", "motion"), seed_for(1, "cat", "motion"),
                seed_for(1, "coffee", "events")}) == 4  # fmt: skip
    assert seed_for(1, "1a", "b") != seed_for(11, "a", "b")


def test_the_generator_of_a_name_is_pinned_for_ever():
    assert generator_for(1, "coffee", "motion").integers(0, 1000, 4).tolist() == [260, 379, 998, 973]
    assert seed_for(0, "", "") == 14014920894283999531


def test_a_missing_gpu_is_refused_with_the_way_out():
    with pytest.raises(ValueError, match="use device=cpu"):
        device_of(dataclasses.replace(RUNTIME, device="cuda:99"))


@pytest.mark.parametrize(("units", "precision"), [([], "fp32"), (["AMX"], "bf16")])
def test_automatic_precision_is_bf16_only_where_the_device_has_units_for_it(monkeypatch, units, precision):
    monkeypatch.setattr(runtime, "bf16_units", lambda device: units)
    cpu = torch.device("cpu")
    assert [precision_on(cpu, asked) for asked in ("auto", "fp32", "bf16")] == [precision, "fp32", "bf16"]


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other allocators are left as they are")
def test_a_large_array_takes_the_memory_of_the_one_before():
    keep_freed_memory()
    bytes_each = 2**26
    np.ones(bytes_each, np.uint8)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    np.ones(bytes_each, np.uint8)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before < bytes_each / resource.getpagesize() / 4


def test_a_task_on_one_thread_leaves_the_threads_of_its_process_as_they_were():
    torch.set_num_threads(2)
    assert runtime.on_one_thread(lambda item: (item, torch.get_num_threads()), "coffee") == ("coffee", 1)
    assert torch.get_num_threads() == 2
