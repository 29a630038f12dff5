"""Every knob of GRMM in frozen dataclasses, with the paper's numbers as defaults.

Each field that the paper leaves silent names where its value comes from. Abbreviations: P = the
GRMM paper; G = the project's survey of Gaussian head models (numbers of its section 5), which read
RGCA (Saito 2024), GHA (Xu 2024), ASH (Pang 2024), GaussianAvatars (Qian 2024) and DeepSDF
(Park 2019).
"""

from __future__ import annotations

from dataclasses import dataclass, field

from express50.errors import ConfigError

FRAMES = ("head", "tangent")
DEPTH_NORMALISATIONS = ("minmax", "fixed")
PRECISIONS = ("float32", "bfloat16")


@dataclass(frozen=True, kw_only=True)
class ModelConfig:
    """Dimensions and activations of the networks."""

    n_g: int = 512
    """Side of the UV map of Gaussians, texels. P: N_g = 512. 0: as many as the head's pixels in the
    training images call for, at most 512."""
    z_id: int = 512
    """Length of the residual identity code. P."""
    z_exp: int = 256
    """Length of the residual expression code. P."""
    features: int = 32
    """Learned features a Gaussian carries besides RGB. P: 32."""
    shared_widths: tuple[int, ...] = (512, 256)
    """Widths of MLP_shared; silent in P. G8: 518 -> 512 -> 256, so that d = 256 + z_exp = 512."""
    film_width: int = 256
    """Hidden width of MLP_FiLM; silent in P. G8."""
    mesh_width: int = 256
    """Hidden width of both displacement heads; silent in P. G8, after RGCA's geometry decoder."""
    mesh_decoder: bool = True
    """False: no vertex displacements (the paper's ablation "no mesh decoder")."""
    mouth: bool = True
    """False: no Gaussians on teeth, tongue and the inside of the mouth (the supplement's ablation
    of the extended UV map); heads without those regions are drawn all the same."""
    residual_codes: bool = True
    """False: decoders see tracked parameters in place of codes (the ablation "no residuals")."""
    displacement_scale: float = 1e-2
    """Metres a unit network output displaces a vertex or a Gaussian; silent in P. G5, G8."""
    seed_channels: int = 256
    """Channels of the 8 x 8 seed of the decoders; silent in P. G6 (RGCA)."""
    ladder: tuple[int, ...] = (256, 128, 128, 64, 32)
    """Channels after each doubling but the last; silent in P. G6: six doublings reach 512."""
    view_channels: int = 8
    """Channels the view direction is lifted to before it joins the seed. G7 (RGCA)."""
    identity_modes: int = 0
    """Linear per-texel modes driven by the first entries of z_id, 0 = none (P). Not in P: the
    convolutions share weights over texels, so details of an identity need many iterations;
    identity-specific bias maps (Cao 2022, Authentic Volumetric Avatars) are the precedent. They
    reach geometry, opacity and RGB, not the features."""
    code_spread: float = 1.0
    """Spread the warm start gives to the identity codes along the modes; used with modes only."""
    frame: str = "head"
    """Axes in which the decoders offset Gaussians: ``head`` (P: p = p_in + dp, r = dr, in head
    space) or ``tangent`` (the posed triangle's frame, as GaussianAvatars). G5."""
    opacity_init: float = 0.5
    """Opacity before training; silent in P. G3: RGCA's 0.5."""
    opacity_from_expression: bool = False
    """True: opacity also sees z_exp. P: identity only. G3 says why one may want it."""
    scale_init: float = 1.0
    """Initial standard deviation of a Gaussian in units of the texel spacing. G2."""
    thickness_init: float = 0.3
    """Initial extent along the normal over the tangential one (``tangent`` frame only). G2."""
    scale_min_mm: float = 0.1
    scale_max_mm: float = 10.0
    """Range of scales in millimetres. P (units silent; G2). At another n_g both are multiplied by
    512 / n_g (scale_bounds_mm), because the texels are that much further apart."""
    refine_widths: tuple[int, ...] = (32, 48, 64, 96)
    """Channels of the refinement U-Net per level; empty switches it off. Silent in P. G9."""
    refine_unshuffle: int = 1
    """Pixel-unshuffle factor before the refinement. G9: 2 makes it four times cheaper."""
    refine_alpha: bool = True
    """Give the rendered alpha to the refinement too. G9; P lists RGB, features and depth."""
    depth_normalisation: str = "minmax"
    """``minmax`` over the pixels with alpha > 0.5 (P, G10) or ``fixed`` (head centre +- 0.2 m)."""
    backend: str = "auto"
    """Rasteriser: auto, reference, cpu, gsplat."""
    precision: str = "float32"
    """What convolutions and perceptrons compute in: ``float32``, or ``bfloat16`` where the machine
    has it in hardware. Weights, meshes, Gaussians and images are float32. Silent in P."""

    def __post_init__(self) -> None:
        side = self.n_g / 2 ** (len(self.ladder) + 1)
        if self.n_g and (side < 2 or side != int(side)):
            raise ConfigError(
                f"model.n_g is {self.n_g}, expected a multiple of {2 ** (len(self.ladder) + 1)}, "
                f"at least twice it: a ladder of {len(self.ladder)} widths doubles that often"
            )
        _one_of("model.frame", self.frame, FRAMES)
        _one_of("model.precision", self.precision, PRECISIONS)
        _one_of("model.depth_normalisation", self.depth_normalisation, DEPTH_NORMALISATIONS)
        _in_range("model.opacity_init", self.opacity_init, 0.01, 0.99)
        _in_range("model.scale_min_mm", self.scale_min_mm, 1e-6, self.scale_max_mm)
        if self.identity_modes > self.z_id:
            raise ConfigError(
                f"model.identity_modes is {self.identity_modes}, "
                f"expected at most z_id = {self.z_id}"
            )

    @property
    def scale_bounds_mm(self) -> tuple[float, float]:
        """Range of scales at this n_g, millimetres."""
        factor = 512 / self.n_g
        return self.scale_min_mm * factor, self.scale_max_mm * factor


@dataclass(frozen=True, kw_only=True)
class LossConfig:
    """Weights of the objective (P, Training and Losses); units are in the names of the terms."""

    l1: float = 0.8
    ssim: float = 0.2
    perceptual: float = 0.04
    vgg16: str = ""
    """Path of torchvision's vgg16 state dict; empty: the term is off, and train says so."""
    perceptual_crop_px: int = 0
    """Side of a random crop for the perceptual term, 0 = whole image; for CPUs."""
    perceptual_every: int = 1
    """Evaluate the perceptual term every so many iterations; for CPUs."""
    depth: float = 0.5
    """Weight of the squared depth error in decimetres squared. P (units silent); G11."""
    depth_erode_px: int = 2
    """Pixels the depth mask is eroded by: expected depth bleeds at silhouettes. G11."""
    scale: float = 0.1
    laplacian: float = 0.01
    """Weight of the Laplacian of the vertex displacements, millimetres squared. P; G12."""
    codes: float = 0.001
    """Weight of the sum of squares of both codes. P; G13."""

    def __post_init__(self) -> None:
        weights = ("l1", "ssim", "perceptual", "depth", "scale", "laplacian", "codes")
        _not_negative("loss", self, *weights)
        if self.perceptual_every < 1:
            raise ConfigError(f"loss.perceptual_every is {self.perceptual_every}, expected >= 1")


@dataclass(frozen=True, kw_only=True)
class DataConfig:
    """What is read from the shards."""

    split: str = "train"
    holdout_cameras: tuple[str, ...] = ()
    """Camera ids that training never sees; metrics.json reports on them."""
    holdout_expressions: tuple[str, ...] = ()
    """SUBJECT/EXPRESSION frames that training never sees, as shell patterns (S002/smile, */wink*).
    Others must show the expression, or it has no code; metrics.json reports on them."""
    background: float = 0.0
    """Grey that footage and renderings are composited on, sRGB in [0, 1]. Silent in P. G15."""
    torso: str = "ignore"
    """Pixels of shoulders and clothes: ``ignore`` them in losses and metrics (the paper's data
    were masked to the head; see grmm.torso) or ``keep`` them as if the head model held them."""
    crop_margin_px: int = 16
    """Train on the window around head and matte, this much larger; -1 = the whole image. Outside
    both, footage and rendering are background. Evaluation always takes the whole image."""
    cache_mb: int = 512
    """Decoded samples kept in memory, megabytes."""

    def __post_init__(self) -> None:
        _one_of("data.torso", self.torso, ("ignore", "keep"))
        _in_range("data.background", self.background, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """The optimiser and the loop."""

    iterations: int = 250_000
    """P: 250,000."""
    seconds: float = 0.0
    """Stop after this much training time too, 0 = no limit. Wall time, resumed runs add up."""
    lr: float = 1e-4
    """Adam's rate for all parameters. P."""
    code_lr_scale: float = 1.0
    """Factor for the codes' rate. P: one rate for all; G13 explains why 10 is useful."""
    texel_lr_scale: float = 1.0
    """Factor for the rate of per-texel parameters (untied biases, modes) of the last layers."""
    refine_lr_scale: float = 1.0
    """Factor for the refinement's rate. P: 1, at 1e-4. At the demo's 2e-3 the first steps of a
    zero-initialised head throw the image about, and the network then learns to keep still."""
    final_lr: float = 1.0
    """Last rate over the first, reached along a half cosine. P states no decay. G16."""
    betas: tuple[float, float] = (0.9, 0.999)
    accumulate: int = 1
    """Views whose gradients are averaged in a step (4 stands for the paper's four GPUs)."""
    clip_norm: float = 0.0
    """Clip the gradient's norm, 0 = never. Silent in P."""
    ema: float = 0.0
    """Share of their former mean that averaged weights keep in a step, 0.999 for example; the
    checkpoint holds the mean then. 0: no averaging. Silent in P."""
    tensorboard: bool = False
    """Write OUT/tensorboard too; needs the extra ``tensorboard``."""
    shuffle_directions: float = 0.0
    """Share of views whose colours are decoded for another training camera's direction. Not in P:
    with few cameras the colour decoder learns by heart what each sees, and errs in between."""
    warm_start: bool = True
    """Start from the mean texture of the training images. Silent in P; G17."""
    warm_start_images: int = 96
    """Images per subject used for the mean texture, evenly chosen."""
    overfit: int = 0
    """Train on only this many views, 0 = all: a check that model and data can meet at all."""
    seed: int = 0
    save_every: int = 1000
    """Iterations between checkpoints."""
    save_seconds: float = 120.0
    """A checkpoint is written after so much time too, 0 = never: what a kill may cost."""
    log_every: int = 20
    evaluate_images: int = 32
    """Images evaluated at the end for metrics.json, evenly chosen."""
    threads: int = 0
    """Threads of torch, 0 = leave as it is."""

    def __post_init__(self) -> None:
        _not_negative("train", self, "seconds", "save_seconds", "final_lr", "clip_norm")
        _not_negative("train", self, "code_lr_scale", "texel_lr_scale", "refine_lr_scale")
        _in_range("train.lr", self.lr, 1e-12, 1.0)
        _in_range("train.shuffle_directions", self.shuffle_directions, 0.0, 1.0)
        _in_range("train.ema", self.ema, 0.0, 0.99999)
        for name in ("iterations", "accumulate", "save_every", "log_every"):
            if getattr(self, name) < 1:
                raise ConfigError(f"train.{name} is {getattr(self, name)}, expected >= 1")


@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """Two-stage fit of an unseen identity (P, Fitting via Inverse Rendering); silences: G22."""

    stage1_iterations: int = 500
    stage2_iterations: int = 350
    seconds: float = 0.0
    """Stop after this much time in all, 0 = no limit; stage 1 gets stage1_share of it."""
    stage1_share: float = 0.35
    stage1_lr: float = 1e-2
    stage1_final_lr: float = 0.1
    """Rate at the end of stage 1 over the rate at its start (1e-2 -> 1e-3)."""
    stage2_lr: float = 1e-4
    stage2_texel_lr_scale: float = 1.0
    shuffle_directions: float = 0.0
    """As train.shuffle_directions, in stage 2: one or two views say little of view dependence."""
    tune_refinement: bool = False
    """Fine-tune the refinement too. P names only the decoders."""
    texture_warm_start: bool = False
    """Stage 2 starts from the colours that the given images show, where they show any. Not in P."""
    locality: float = 0.1
    """Weight of the locality loss. P."""
    locality_t: float = 0.3
    """Weight of the fitted subject in the interpolation. P, supplement."""
    locality_every: int = 1
    """Evaluate the locality loss every so many iterations (its weight grows by as much)."""
    codes: float = 0.001
    seed: int = 0

    def __post_init__(self) -> None:
        _not_negative("fit", self, "seconds", "stage1_final_lr", "stage2_texel_lr_scale")
        _not_negative("fit", self, "locality", "codes")
        _in_range("fit.stage1_lr", self.stage1_lr, 1e-12, 1.0)
        _in_range("fit.stage2_lr", self.stage2_lr, 1e-12, 1.0)
        _in_range("fit.stage1_share", self.stage1_share, 0.0, 1.0)
        _in_range("fit.shuffle_directions", self.shuffle_directions, 0.0, 1.0)
        _in_range("fit.locality_t", self.locality_t, 0.0, 1.0)
        if self.locality_every < 1:
            raise ConfigError(f"fit.locality_every is {self.locality_every}, expected >= 1")


@dataclass(frozen=True, kw_only=True)
class MetricsConfig:
    """Weights of the networks that LPIPS and FID compare images with; none are distributed."""

    alexnet: str = ""
    """Path of torchvision's alexnet state dict for LPIPS; empty: n/a. Backbone silent in P. G23."""
    inception: str = ""
    """Path of the FID Inception network as TorchScript (inception-2015-12-05.pt); empty: n/a."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """Everything; the resolved instance is stored in each checkpoint."""

    model: ModelConfig = field(default_factory=ModelConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    data: DataConfig = field(default_factory=DataConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    metrics: MetricsConfig = field(default_factory=MetricsConfig)


def _one_of(name: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise ConfigError(f"{name} is {value!r}, expected one of {', '.join(allowed)}")


def _not_negative(table: str, config: object, *names: str) -> None:
    for name in names:
        if not 0 <= getattr(config, name) < float("inf"):
            raise ConfigError(f"{table}.{name} is {getattr(config, name)}, expected 0 or more")


def _in_range(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ConfigError(f"{name} is {value}, expected {low} to {high}")
