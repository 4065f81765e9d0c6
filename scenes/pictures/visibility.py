"""Picture of what is learnt of visibility in the scene `house`, beside the truth.

    python scenes/pictures/visibility.py

Both are shares of the light that would arrive at a pixel if nothing were in the way: what should
arrive by what an earlier render has learnt, and what does.
"""

from pathlib import Path

import manylights
import matplotlib
import mitsuba as mi
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

mi.set_variant("llvm_ad_rgb")
LUMINANCE = [0.2126, 0.7152, 0.0722]


def channels(scene: mi.Scene, learn) -> tuple[np.ndarray, np.ndarray]:
    """Luminance that arrives, and that is expected, in the second of two renders."""
    props = {"type": "manylights_direct", "counts": True, "learn_visibility": learn}
    integrator = mi.load_dict(props)
    for seed in range(2):
        image = np.array(mi.render(scene, integrator=integrator, spp=256, seed=seed))
    added = integrator.aov_names()
    return image[..., :3] @ LUMINANCE, image[..., added.index("expected") - len(added)]


def main() -> None:
    """Render and draw."""
    scene = mi.load_dict(manylights.scenes.house(1000, width=384, height=216))
    arrived, expected = channels(scene, "keep")
    _, unshadowed = channels(scene, False)
    learnt, true = expected / unshadowed, arrived / unshadowed
    print(f"mean {learnt.mean():.3f} learnt, {true.mean():.3f} true")
    print(f"correlation {np.corrcoef(learnt.ravel(), true.ravel())[0, 1]:.3f}")
    figure, axes = plt.subplots(1, 2, figsize=(10, 3), layout="constrained")
    for axis, values, title in zip(axes, (learnt, true), ("learnt", "true")):
        shown = axis.imshow(values, vmin=0, vmax=1)
        axis.set_title(title)
        axis.axis("off")
    figure.colorbar(shown, ax=axes)
    figure.savefig(Path(__file__).with_suffix(".jpg"), dpi=100)


if __name__ == "__main__":
    main()
