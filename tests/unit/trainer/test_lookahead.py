"""Look-ahead keeps the batches and their order, and announces the next ones."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.utils.data import BatchSampler, DataLoader, RandomSampler, TensorDataset

from embomatrix.trainer.data.lookahead import Lookahead


@given(st.lists(st.integers(), max_size=20), st.integers(0, 25))
def test_batches_keep_their_order_and_the_window_shows_the_next_ones(batches, steps):
    ahead = Lookahead(batches, steps=steps)
    seen = []
    for batch in ahead:
        assert ahead.window() == tuple(batches[len(seen) : len(seen) + steps + 1])
        seen.append(batch)
    assert seen == batches
    assert ahead.window() == ()


def test_shuffling_loader_is_iterated_once_per_epoch():
    def epochs(wrap):
        generator = torch.Generator().manual_seed(4)
        data = TensorDataset(torch.arange(20))
        loader = wrap(DataLoader(data, batch_size=4, shuffle=True, generator=generator))
        return [[batch[0].tolist() for batch in loader] for _ in range(2)]

    assert epochs(lambda loader: Lookahead(loader, steps=3)) == epochs(lambda loader: loader)


def test_sampler_look_ahead_reads_no_data():
    read = []

    class Data(TensorDataset):
        def __getitem__(self, index):
            read.append(index)
            return super().__getitem__(index)

    data = Data(torch.arange(12))
    sampler = Lookahead(BatchSampler(RandomSampler(data), 3, drop_last=False), steps=2)
    loader = iter(DataLoader(data, batch_sampler=sampler))
    first = next(loader)[0].tolist()
    window = sampler.window()
    assert window[0] == first
    assert len(window) == 3
    assert sorted(read) == sorted(first)
    rest = [batch[0].tolist() for batch in loader]
    assert rest[:2] == list(window[1:])
    assert len(sampler) == 4


def test_next_epoch_is_complete_after_an_early_exit():
    ahead = Lookahead([1, 2, 3], steps=1)
    assert next(iter(ahead)) == 1
    assert list(ahead) == [1, 2, 3]


def test_negative_window_is_rejected():
    with pytest.raises(ValueError, match="look-ahead of -1 steps"):
        Lookahead([1], steps=-1)
