"""One of the processes that train together, as `DistributedDataParallel` has them."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_of(world: int, rank: int, address: str, backend: str = "gloo") -> Iterator[None]:
    """The group of `world` processes that meet in the file `address`; its end is the process's own.

    PyTorch's threads of a group may outlive it, and abort a process whose interpreter is being taken down when they
    let go of the last tensors (pytorch/pytorch#179291). So it ends here, at once; an exception goes on as ever.
    """
    torch.distributed.init_process_group(backend, init_method=f"file://{address}", rank=rank, world_size=world)
    yield
    torch.distributed.destroy_process_group()
    os._exit(0)
