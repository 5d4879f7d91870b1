"""A training epoch of the adapter in plain PyTorch.

    python training.py [WIDTH ...]

The sizes of `cargo bench --bench hot_paths -- epoch`: 30,000 pairs of 1,000 frames, batches of 512, φ with 64 hidden and 20
output columns, AdamW with clipping, one thread. φ is computed for both ends of each pair. Prints the median time of an epoch in
milliseconds with the least and the largest. Needs torch.
"""

import sys
import time

import torch
from torch import nn

FRAMES, PAIRS, BATCH, EPOCHS = 1_000, 30_000, 512, 7


def epochs(width):
    torch.manual_seed(0)
    features = torch.randn(FRAMES, width)
    source = torch.randint(0, 960, (PAIRS,))
    target = source + torch.randint(10, 41, (PAIRS,))
    motions = torch.randn(PAIRS, 6)
    phi = nn.Sequential(nn.Linear(width, 64), nn.LayerNorm(64), nn.GELU(), nn.Linear(64, 20))
    motion = nn.Linear(20, 6, bias=False)
    parameters = [*phi.parameters(), *motion.parameters()]
    optimizer = torch.optim.AdamW(parameters, lr=1e-3, weight_decay=1e-2)
    for _ in range(EPOCHS):
        began = time.perf_counter()
        for batch in torch.randperm(PAIRS).split(BATCH):
            read = motion(phi(features[target[batch]]) - phi(features[source[batch]]))
            loss = nn.functional.mse_loss(read, motions[batch])
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(parameters, 1.0)
            optimizer.step()
        yield (time.perf_counter() - began) * 1e3


def main():
    torch.set_num_threads(1)
    for width in [int(word) for word in sys.argv[1:]] or [768, 256]:
        _warm, *times = epochs(width)
        times.sort()
        print(f"PyTorch {torch.__version__}, {width} columns: {times[len(times) // 2]:.0f} [{times[0]:.0f}, {times[-1]:.0f}] ms an epoch")


main()
