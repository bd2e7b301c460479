"""polarnet's own network: it solves the redundancy of four polarizers at many scales and refines it with a U-Net."""

import math
from typing import Annotated, Any, NamedTuple, TypeVar

import torch
from jaxtyping import Float
from pydantic import Field, NonNegativeFloat, PositiveFloat
from torch import Tensor, nn
from torch.nn import functional as F

from polarnet.networks.base import blocks
from polarnet.networks.polarnet import kernels, redundancy, refinement
from polarnet.networks.polarnet import panorama as panoramas
from polarnet.networks.polarnet.expected_error import ExpectedError, error_features
from polarnet.networks.polarnet.panorama import Memory, Motion, Panorama
from polarnet.networks.polarnet.redundancy import block_means, length
from polarnet.networks.polarnet.refinement import WIDE, Counts
from polarnet.networks.polarnet.sensor import Equaliser, Scale, scale_features
from polarnet.runtime.sections import section
from polarnet.stokes import Prediction

STRIDE = 4  # stride of the finest recurrent layer; height and width (in blocks of `binning`) are padded to multiples
IMAGES = 2  # input images per channel: sum of polarities and number of events (representation `event_counts`)
PARTS = ("redundancy", "slopes", "shot_noise", "sums", "recurrence", "panorama", "sensitivity", "scale")
MIDDLE_DOLP = 0.3  # initial DoLP of the constant candidate
NOISE_TENSORS = SENSITIVITY_TENSORS = 2  # of the state, see `StokesUNet`
NO_STATE: list[Any] = [None] * (2 + len(WIDE))  # before the first window: no sums, moments, wide sums or panorama
SOLVER_TENSORS = NOISE_TENSORS + SENSITIVITY_TENSORS + len(NO_STATE) + 1 + len(Panorama._fields)
MAX_BINNING = 8
Binning = Annotated[int, Field(ge=1, le=MAX_BINNING)]
Item = TypeVar("Item")
Few = Annotated[list[Item], Field(max_length=16)]


@section
class StokesUNetConfig:
    """Section `networks.polarnet` of params.yaml."""

    binning: Binning
    """Side in pixels of the blocks whose events are averaged before anything else. Computing time falls with its
    square; the outputs are interpolated back to the sensor's size."""
    channels: Few[Annotated[int, Field(gt=0, le=1024)]]
    """Channels at 1/2, 1/4, 1/8, ... of the resolution; at least three numbers."""
    memories: Few[Annotated[float, Field(ge=0, le=0.999)]]
    """Decay per window of each event sum that feeds the redundancy solver (0: present window only)."""
    decays: Few[Annotated[float, Field(ge=0, le=0.999)]]
    """Decay per window of each sum of second moments."""
    scales: Few[Annotated[int, Field(ge=0, le=4096)]]
    """Widths of the neighbourhoods solved together, in pixels at quarter resolution, odd; 0: the whole image."""
    reach: Annotated[int, Field(gt=0, le=1000)]
    """Search range in pixels along each axis for the scene's motion from window to window."""
    panorama_margin: Annotated[int, Field(gt=0, le=4096)]
    """Margin of the panorama beyond the image, in pixels at half resolution."""
    panorama_prior: PositiveFloat
    """This field and the next four set the panorama filter: see `polarnet.networks.polarnet.panorama.Memory`."""
    panorama_noise: PositiveFloat
    panorama_drift: NonNegativeFloat
    panorama_renewal: Annotated[float, Field(ge=0, le=1)]
    panorama_fade: Annotated[float, Field(ge=0, le=1)]
    panorama_step: PositiveFloat
    """Change of natural-log intensity per event of a sensor with scale 1 (`Scale`)."""
    panorama_scale: Annotated[int, Field(gt=0, le=4096)]
    """Width of the neighbourhood whose mean comes from the network instead of the panorama, in pixels at quarter
    resolution, odd."""
    panorama_share: Annotated[float, Field(ge=0.01, le=0.99)]
    """Initial weight of the panorama where it is certain. The U-Net learns a weight for each pixel."""
    without: list[str]
    """Parts (of PARTS) to ablate: redundancy (all candidates are 0), slopes (the panorama's candidates are 0),
    shot_noise (isolated events do not move the level), sums (the gains of event sums are 0), recurrence (recurrent
    layers restart in each window), panorama, sensitivity (events keep their weights), scale (every sensor has the
    threshold `panorama_step`)."""

    def __post_init__(self):
        if len(self.channels) < 3 or not (self.memories and self.decays and self.scales):
            raise ValueError(f"channels, memories, decays, scales: expected at least 3, 1, 1, 1 numbers, got {self}")
        if any(scale and scale % 2 == 0 for scale in self.scales):
            raise ValueError(f"scales: expected odd numbers, or 0 for the whole image, got {self.scales}")
        if self.panorama_scale % 2 == 0:
            raise ValueError(f"panorama_scale: expected an odd number, got {self.panorama_scale}")
        if unknown := set(self.without) - set(PARTS):
            raise ValueError(f"without: expected some of {', '.join(PARTS)}, got {', '.join(sorted(unknown))}")

    @property
    def network_class(self) -> type[Any]:
        """Class of the network with these settings."""
        return StokesUNet


class Candidates(NamedTuple):
    """Least-squares solutions at quarter resolution: of events, one per memory, decay and scale; then of the panorama,
    one per scale."""

    s1: Float[Tensor, "n c h w"]
    s2: Float[Tensor, "n c h w"]
    dolp: Float[Tensor, "n c h w"]
    evidence: Float[Tensor, "n c h w"]
    """Weighted number of events behind the solution; for the panorama, weighted energy of its slopes."""


class Solved(NamedTuple):
    """First half of the network, for n = t * b images: the input of `StokesUNet.refine_windows`."""

    x2: Float[Tensor, "n c h/2 w/2"]
    """The U-Net's features at half resolution."""
    candidates: Candidates
    sums: list[Float[Tensor, "t b m 2 h w"]]
    """Sums of e0 - e90 and e45 - e135 for each memory, at single pixels and averaged over each width of `WIDE`."""
    scale: Float[Tensor, "n 1 1 1"]
    """Factor of the sums: `Scale`."""
    images: Float[Tensor, "n 4 h/2 w/2"]
    """The panorama's four images, in steps of `panorama_step`."""
    certain: Float[Tensor, "n 1 1 1"]
    """The panorama's certainty."""
    noise: Counts
    """Isolated events, mostly of shot noise."""
    size: tuple[int, int]
    """Height and width of the sensor."""


class StokesUNet(nn.Module):
    """Recurrent network from the events of four channels to DoLP, AoLP and DoLP's expected squared error.

    0. Sensor: each event is weighted by its pixel's estimated threshold relative to other pixels', and all event sums
       by the sensor's estimated threshold (module `sensor`).
    1. Mixing: the redundancy gives candidates for (s1, s2) from changes in time and from the panorama's slopes. The
       U-Net mixes these and a constant at each pixel. The mixture is coarse but on the true scale.
    2. Refinement (module `refinement`): where there is much shot noise, the rates of isolated events move the level of
       the whole sensor. Event sums, times gains from the U-Net, add the fine structure. The result is averaged with the
       panorama (module `panorama`), whose weight the U-Net chooses at each pixel.
    3. Correction: the U-Net sees the result and adds an unconstrained correction.

    The state is a list: two tensors of isolated events, two of the pixels' sensitivities, the event sums, the sums of
    moments, and the sums averaged over each width of `WIDE`; then the events of the previous window with the panorama,
    and the states of the recurrent layers.

    DoLP is predicted separately from the length of (s1, s2). Where (s1, s2) are uncertain, their mean is too short,
    like any mean over angles. No activation bounds the outputs, as in the paper's network.
    """

    representation = "event_counts"
    predicts_stokes = True
    optimizer = "muon"
    outputs = ("choose", "gains", "trust", "add", "scale.out")
    memories: Float[Tensor, " m"]
    decays: Float[Tensor, " d"]

    def __init__(self, config: StokesUNetConfig, in_channels: int = 4 * IMAGES):
        super().__init__()
        if in_channels != 4 * IMAGES:
            raise ValueError(f"network=polarnet: expected 8 images a window, got {in_channels}; use event_counts")
        self.binning, self.scales = config.binning, config.scales
        self.register_buffer("memories", torch.tensor(config.memories), persistent=False)
        self.register_buffer("decays", torch.tensor(config.decays), persistent=False)
        self.without = frozenset(config.without)
        self.reach, self.margin = config.reach, config.panorama_margin
        self.memory = Memory(*(getattr(config, f"panorama_{name}") for name in Memory._fields))
        self.step, self.around = config.panorama_step, config.panorama_scale
        memories, scales = len(config.memories), len(config.scales)
        solved = (memories * len(config.decays) + 1) * scales
        half, quarter, *smaller = config.channels
        self.equaliser = Equaliser()
        self.scale = Scale()
        self.moments = redundancy.SecondMoments(memories)
        self.solve = redundancy.LeastSquares(memories, len(config.decays), scales)
        self.slopes = redundancy.SlopeMoments()
        self.solve_slopes = redundancy.LeastSquares(1, 1, scales)
        self.shot_noise = refinement.ShotNoise()
        self.stem = blocks.conv3x3(4 * (4 * memories + 1), half)
        self.from_mosaic = nn.Conv2d(5, half, kernel_size=3, padding=1, bias=False)  # name in shipped weights
        self.to_quarter = nn.Conv2d(half, quarter, kernel_size=2, stride=2)
        self.from_candidates = nn.Conv2d(len(Candidates._fields) * solved, quarter, kernel_size=1)
        self.join = blocks.conv3x3(quarter, quarter)
        self.gru_quarter = blocks.ConvGRU(quarter)
        self.smaller = blocks.Level(quarter, smaller)
        self.at_quarter = blocks.ResidualBlock(quarter)
        self.choose = nn.Conv2d(quarter, solved + 1, kernel_size=1)
        self.up_half = blocks.UpBlock(quarter, half)
        self.at_half = blocks.ResidualBlock(half)
        self.gains = nn.Conv2d(half, 4 * (1 + len(WIDE)) * memories, kernel_size=1)
        self.trust = nn.Conv2d(half, 1, kernel_size=1)
        self.look = blocks.conv3x3(half + 4 * 3, half)
        self.refine = blocks.ResidualBlock(half)
        self.add = nn.Conv2d(half, 3 * 4, kernel_size=1)  # s1, s2 and DoLP of 2x2 pixels
        self.constant = nn.Parameter(torch.tensor(MIDDLE_DOLP))
        self.expected = ExpectedError()
        for tensor in nn.ModuleList([self.choose, self.gains, self.add, self.trust]).parameters():
            nn.init.zeros_(tensor)
        assert self.trust.bias is not None
        nn.init.constant_(self.trust.bias, math.log(config.panorama_share / (1 - config.panorama_share)))

    def forward(
        self, inputs: Float[Tensor, "b 8 h w"], state: list[Tensor] | None = None
    ) -> tuple[Prediction, list[Tensor]]:
        """Process one window of b streams. `state` comes from the previous window; None at the start."""
        prediction, state = self.unroll(inputs[None], state)
        return Prediction(*(field[0] for field in prediction if field is not None)), state

    def unroll(
        self, inputs: Float[Tensor, "t b 8 h w"], state: list[Tensor] | None = None
    ) -> tuple[Prediction, list[Tensor]]:
        """Process t windows of b streams at once: same result as `forward` per window, in fewer operations."""
        prediction, _, state = self.unroll_with_features(inputs, state)
        return prediction, state

    def unroll_with_features(
        self, inputs: Float[Tensor, "t b 8 h w"], state: list[Tensor] | None = None
    ) -> tuple[Prediction, Float[Tensor, "n k h2 w2"], list[Tensor]]:
        """Same as `unroll`, with the `error_features` of the n = t * b padded images at half resolution."""
        before = state or []
        solved, solver = self.solve_windows(inputs, before[:SOLVER_TENSORS])
        prediction, features, recurrent = self.refine_windows(solved, before[SOLVER_TENSORS:])
        return prediction, features, [*solver, *recurrent]

    def solve_windows(self, inputs: Float[Tensor, "t b 8 h w"], state: list[Tensor]) -> tuple[Solved, list[Tensor]]:
        """First half of `unroll`: everything before the recurrent layers. `state` is empty at the start."""
        b, height, width = inputs.shape[1], *inputs.shape[-2:]
        noise, isolated = refinement.isolated_events(inputs[:, :, 1::IMAGES], state[:NOISE_TENSORS])
        side = STRIDE * self.binning
        inputs = block_means(F.pad(inputs, (0, -width % side, 0, -height % side)), self.binning)  # no events in padding
        polarity, count = inputs.unflatten(2, (4, IMAGES)).unbind(3)
        state = state[NOISE_TENSORS:]
        equalised, sensitivity = self.equaliser(polarity, count, state[:SENSITIVITY_TENSORS])
        if "sensitivity" not in self.without:
            polarity, count = equalised.polarity, equalised.events
        before_sums, before_moments, *others = state[SENSITIVITY_TENSORS:] or NO_STATE
        before_wide, before_panorama = others[: len(WIDE)], others[len(WIDE) :]

        keep = self.memories.view(-1, 1, 1, 1)
        sensor = (math.ceil(height / self.binning), math.ceil(width / self.binning))
        panorama, certain, next_panorama = self._panorama(polarity, sensor, before_panorama)
        clues = scale_features(panorama, equalised.total.flatten(), equalised.mismatch.flatten())
        scale = torch.ones_like(certain) if "scale" in self.without else self.scale(clues)
        images = scale * self.step * panorama
        steps, moments, of_events = self._event_sums(polarity, count, scale, before_sums)
        wide = refinement.wide_differences(polarity, before_wide, keep)
        from_sums, moments = self._candidates(moments, b, before_moments)
        from_slopes = self._slope_candidates(images)
        candidates = Candidates(*(torch.cat(pair, dim=1) for pair in zip(from_sums, from_slopes, strict=True)))

        x2 = blocks.on_blocks(self.stem, of_events)
        centred = torch.cat([images - images.mean((-1, -2), keepdim=True), certain.expand_as(images[:, :1])], dim=1)
        x2 = F.relu(x2 + self.from_mosaic(centred.contiguous(memory_format=torch.channels_last)))
        sums = [refinement.differences(steps), *wide]
        solved = Solved(x2, candidates, sums, scale, images, certain, noise, (height, width))
        return solved, [*isolated, *sensitivity, steps[-1], moments, *(means[-1] for means in wide), *next_panorama]

    def refine_windows(
        self, solved: Solved, state: list[Tensor]
    ) -> tuple[Prediction, Float[Tensor, "n k h2 w2"], list[Tensor]]:
        """Second half of `unroll`. `state` holds the states of the recurrent layers, empty at the start."""
        x2, candidates, sums, scale, images, certain, noise, (height, width) = solved
        t, b = sums[0].shape[:2]
        y4, recurrent = self._quarter(x2, candidates, b, state)
        y2 = self.at_half(self.up_half(y4, skip=x2))

        weights = self.choose(y4).float().softmax(1)  # of the candidates, and of the constant, which is DoLP alone
        s1, s2, dolp = ((weights[:, :-1] * field).sum(1, keepdim=True) for field in candidates[:3])
        coarse = blocks.enlarged(torch.cat([s1, s2, dolp + weights[:, -1:] * self.constant], dim=1), 4)
        if kernels.compiled_path(scale) and not self.without:
            moves = refinement.compiled_event_moves(sums, y2, self.gains)
        else:
            moves = refinement.event_moves(sums, self._unless("sums", F.pixel_shuffle(self.gains(y2), 2).float()))
        level = refinement.moved_by_noise(coarse[:, :2], self._unless("shot_noise", self.shot_noise(noise)))
        moved = torch.tanh(torch.atanh(refinement.MAX_DOLP * level) + scale * moves)
        dolp = coarse[:, 2:] + (length(*moved.unbind(1)) - length(*coarse[:, :2].unbind(1)))[:, None]
        share = certain * blocks.enlarged(torch.sigmoid(self.trust(y2).float()), 2)
        fine = torch.cat(refinement.averaged(moved, dolp, images[:, 1:3], share, self.around), dim=1)
        features = torch.cat([y2, F.pixel_unshuffle(fine, 2).to(y2.dtype)], dim=1)
        added = F.pixel_shuffle(self.add(self.refine(F.relu(self.look(features)))), 2).float()

        recovered = fine + added
        features = error_features(candidates.dolp, weights[:, :-1], candidates.evidence, recovered[:, 2:])
        log_variance = F.interpolate(self.expected(features), scale_factor=2)
        of_pixels = self._enlarged(torch.cat([recovered, log_variance], dim=1))
        stokes, dolp, log_variance = of_pixels[:, :2], of_pixels[:, 2], of_pixels[:, 3]
        aolp = torch.remainder(torch.atan2(stokes[:, 1], stokes[:, 0]) / 2, math.pi)
        maps = [dolp, aolp, log_variance, stokes]
        prediction = Prediction(*(image[..., :height, :width].unflatten(0, (t, b)) for image in maps))
        return prediction, self._enlarged(features), recurrent

    def _event_sums(
        self,
        polarity: Float[Tensor, "t b 4 h w"],
        count: Float[Tensor, "t b 4 h w"],
        scale: Float[Tensor, "n 1 1 1"],
        before: Float[Tensor, "b m 4 h w"] | None,
    ) -> tuple[Float[Tensor, "t b m 4 h w"], Float[Tensor, "n m 6 h4 w4"], Float[Tensor, "n c h w"]]:
        """Return the faded sums of polarities, their `SecondMoments`, and `_event_images`, both of the scaled sums."""
        keep = self.memories.view(-1, 1, 1, 1)
        if kernels.compiled_path(polarity) and not self.without:
            return self._compiled_event_sums(polarity, count, scale, before)
        steps = redundancy.faded(polarity.unsqueeze(2), keep, before)
        sums = scale.unsqueeze(1) * steps.flatten(0, 1)
        with torch.autocast(polarity.device.type, enabled=False):  # the solution takes differences of similar numbers
            windows = self._unless("redundancy", sums).split(polarity.shape[1])  # a window fits into a core's cache
            moments = torch.cat([self.moments(window, pooled=4) for window in windows])
        return steps, moments, _event_images(sums, scale * count.flatten(0, 1))

    def _compiled_event_sums(
        self, polarity: Tensor, count: Tensor, scale: Tensor, before: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Same as `_event_sums`, with the kernel."""
        t, b, _, height, width = polarity.shape
        memories = len(self.memories)
        steps = polarity.new_empty(t, b, memories, 4, height, width)
        moments = polarity.new_empty(t * b, memories, redundancy.MOMENTS, height // 4, width // 4)
        half = torch.is_autocast_enabled("cpu")
        images = torch.empty(t * b, 4 * memories + 1, height, width, dtype=torch.uint16 if half else torch.float32)
        noise = self.moments.factors()
        before = torch.zeros_like(steps[0]) if before is None else before
        polarity, count = polarity.contiguous(), count.contiguous()
        for n in range(t * b):
            k, stream = divmod(n, b)
            sums = (before if k == 0 else steps[k - 1])[stream]
            window = (polarity[k, stream], count[k, stream], scale[n].numpy()[0, 0, 0])
            outputs = (steps[k, stream], moments[n], images[n])
            kernels.sums_and_moments(sums, *window, self.memories, noise, half, *outputs)
        return steps, moments, images.view(torch.bfloat16) if half else images

    def _candidates(
        self, moments: Float[Tensor, "n m 6 h4 w4"], streams: int, state: Float[Tensor, "b d c h4 w4"] | None
    ) -> tuple[Candidates, Float[Tensor, "b d c h4 w4"]]:
        """Return the candidates from changes in time, and the sums of moments for the next window."""
        with torch.autocast(moments.device.type, enabled=False):  # the solution takes differences of similar numbers
            moments = moments.flatten(1, 2).unflatten(0, (-1, streams)).unsqueeze(2)
            sums = redundancy.faded(moments, self.decays.view(-1, 1, 1, 1), state)
            shape = (len(self.decays), len(self.memories), -1)
            near = redundancy.neighbourhoods(sums.flatten(0, 1).flatten(1, 2), self.scales)
            stacked = torch.stack([mean.unflatten(1, shape).transpose(1, 2) for mean in near], dim=3)
            s1, s2, evidence = self.solve(stacked)
            return Candidates(s1, s2, length(s1, s2), evidence), sums[-1]

    def _slope_candidates(self, images: Float[Tensor, "n 4 h w"]) -> Candidates:
        """Return the candidates from the panorama's differences between neighbouring pixels, at quarter resolution."""
        with torch.autocast(images.device.type, enabled=False):
            moments = self.slopes(self._unless("redundancy", self._unless("slopes", 2 / self.step * images)))
            stacked = torch.stack([*redundancy.neighbourhoods(moments, self.scales)], dim=1)
            s1, s2, _ = self.solve_slopes(stacked[:, None, None, :, :-1])
            return Candidates(s1, s2, length(s1, s2), stacked[:, :, -1])

    @torch.no_grad()
    def _panorama(
        self, polarity: Float[Tensor, "t b 4 h w"], sensor: tuple[int, int], state: list[Tensor]
    ) -> tuple[Float[Tensor, "n 4 h/2 w/2"], Float[Tensor, "n 1 1 1"], list[Tensor]]:
        """Follow the panorama over t windows; return its four images, its certainty from 0 to 1, and the next state.

        The images, in steps and each up to a constant, are the mean of the four log intensities, atanh(s1), atanh(s2),
        and ((log I0 + log I90) - (log I45 + log I135)) / 2. The sensor covers the first `sensor` rows and columns.
        """
        if not state:
            empty = panoramas.empty_panorama(polarity[0, ..., ::2, ::2], self.margin)
            state = [torch.zeros_like(polarity[0, :, 0]), *empty]
        before, level, own, explained = state
        if "panorama" in self.without:
            images = own.new_zeros(len(polarity) * len(own), *own.shape[1:])
            return images, images.new_zeros(len(images), 1, 1, 1), state
        with torch.autocast(polarity.device.type, enabled=False):
            events = torch.cat([before[None], polarity.sum(2)])
            motion = panoramas.displacements(events, self.reach)
            height, width = (size // 2 for size in sensor)
            changes = blocks.contrasts(block_means(polarity, 2))[..., :height, :width] / 2
            panorama, after = Panorama(level, own[..., :height, :width], explained), []
            for change, displacement, reliable in zip(changes, motion.displacement / 2, motion.reliable, strict=True):
                panorama = panoramas.follow(change, Motion(displacement, reliable), panorama, self.memory)
                after.append(panorama)
            images = torch.cat([one.level[..., : own.shape[-2], : own.shape[-1]] for one in after])
            certain = torch.cat([panoramas.certainty(one, self.memory) for one in after])
            own = F.pad(panorama.own, (0, own.shape[-1] - width, 0, own.shape[-2] - height))
            return images, certain, [events[-1], panorama.level, own, panorama.explained]

    def _quarter(
        self, x2: Float[Tensor, "n c h2 w2"], candidates: Candidates, streams: int, state: list[Tensor]
    ) -> tuple[Float[Tensor, "n d h w"], list[Tensor]]:
        """Return the U-Net's features at quarter resolution, and the recurrent states after the last window."""
        inputs = torch.cat([*candidates[:3], torch.log1p(candidates.evidence)], dim=1)
        inputs = inputs.contiguous(memory_format=torch.channels_last)
        x4 = F.relu(self.join(F.relu(self.to_quarter(x2) + self.from_candidates(inputs))))
        restarts = "recurrence" in self.without
        streams, state = (len(x4), []) if restarts else (streams, state)
        g4, first = self.gru_quarter(x4, streams, state[0] if state else None)
        y4, smaller = self.smaller(g4, streams, state[1:])
        return self.at_quarter(y4), [] if restarts else [first, *smaller]

    def _enlarged(self, maps: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h2 w2"]:
        """Interpolate maps of blocks to the sensor's pixels."""
        return maps if self.binning == 1 else blocks.enlarged(maps, self.binning)

    def _unless(self, part: str, x: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
        """Return `x`, or 0 * x if this part is left out (which keeps the gradient path)."""
        return 0 * x if part in self.without else x


def _event_images(sums: Float[Tensor, "n m 4 h w"], count: Float[Tensor, "n 4 h w"]) -> Float[Tensor, "n c h w"]:
    """Stack the U-Net's input from the events: contrasts of every event sum, and the number of events."""
    windows = zip(sums.split(1), count.split(1), strict=True)  # a single window fits into a core's cache
    inputs = (
        torch.cat([blocks.contrasts(one).flatten(1, 2), each.sum(1, keepdim=True) / 2], dim=1) for one, each in windows
    )
    return torch.cat([blocks.compressed(images).contiguous(memory_format=torch.channels_last) for images in inputs])
