# %% [markdown]
# # 09 A training loop of your own
# Rendered views become a torch Dataset that draws new photons each time. A model with learned codes is trained on it.

# %%
import torch
from torch.utils.data import DataLoader, Dataset

import scene2spad as s2s

WIDTH, HEIGHT = 32, 32
STEPS = 4  # a few hundred for a model of any use
VIEWS = [s2s.render(f"rooms/train/{i}", width=WIDTH, height=HEIGHT, bounces=1) for i in range(2)]


class Photons(Dataset):
    def __len__(self) -> int:
        return 2 * STEPS

    def __getitem__(self, number: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return counts (1, T, H, W) and depth [m] (H, W); the number is the seed."""
        histogram = s2s.sense(VIEWS[number % len(VIEWS)], signal=20, background=10, seed=number)
        counts = torch.from_numpy(histogram.counts).movedim(2, 0)[None].float()
        return counts, torch.from_numpy(histogram.depth_m.copy())


# %%
torch.manual_seed(0)
model = s2s.DepthModel(s2s.ModelConfig(design=s2s.Design.named("learned", (256, 4, 4), compression=128)))
optimiser = torch.optim.Adam(model.parameters(), 2e-3)
bin_depth_m = model.config.sensor.bin_depth_m
for step, (counts, depth_m) in enumerate(DataLoader(Photons(), batch_size=2)):
    logits = model(counts)  # (B, T, H, W)
    known = depth_m.isfinite()
    label = (depth_m.nan_to_num() / bin_depth_m).long().clamp(0, logits.shape[1] - 1)
    loss = torch.nn.functional.cross_entropy(logits, label, reduction="none")[known].mean()
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    print(f"step {step}: cross-entropy {loss.item():.3f}")
