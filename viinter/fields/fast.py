"""The fast field: a few surfaces with a texture each, carried by a motion that is linear in the code.

Notation: `V` codes at once, `P` pixels under each, `M` the length of a code, `n` known views, `K` motion polynomials,
`S` sets of `L` layers each. A layer has colours [3, h, w] at about the resolution of a view (half of a large one's, or
a quarter), weights and disparities. Under the code z the pixel xy reads layer l at

    u_l = xy + a(xy, z) + d_l(u) b(xy, z) + e_l(u) c(z),    a = sum_k phi_k(xy) a_k(z),  b = sum_k phi_k(xy) b_k(z),

phi = {1, x, y, x^2, xy, y^2}, and a_k, b_k, c linear in z. With e = 0 that is the image motion of a rigid scene under a
small camera motion (Longuet-Higgins and Prazdny 1980): `a` the part that a rotation gives every depth alike, `b` the
part that a translation gives in proportion to inverse depth. The drift e_l is for what moves by itself: a face that
turns between two pictures. Nothing is told to it: a_k(z), b_k(z), c(z), disparities, drifts and textures are all
learned from the pixels. But b_0 is written as a_0 and a difference, so that parallax begins along the motion of the
whole, as it is under a pure translation: left to itself it may come out too strong in one direction, where horizontal
and vertical edges then choose different disparities. c begins across it, so that d and e together reach everywhere.
Since the motion is linear in z, a mix of codes moves each surface half way where a cross-fade would show it twice.

The disparity d_l(u) = d_l + delta_l(u) has a smooth map delta_l, and e_l(u) is one. The weights are coarser than the
colours too: where a surface ends is a line, and pixels that go over to another surface in each view would learn known
views by heart.

A set's colour is the mean of its layers' colours, weighted by a softmax of their weights: not an alpha compositing,
which trained more slowly and worse. What is drawn is the mean of the sets, and each is trained to be right by itself:
where views leave something open, sets settle it differently, and their mean is nearer to the truth than either (as in
the ensembles of Hansen and Salamon 1990). They share the codes, but each has layers and a motion of its own. While
motions are found, on the coarse levels, a set that falls behind takes that of the best; and before, a field of more and
smaller textures tries motions from several beginnings, and the best of them are taken. At the end sets count with the
shares that have the least error at the known views: a set that took repeating stripes for their neighbours loses its
voice. The sets' textures lie half a pixel apart, or what reading between pixels gets wrong would be wrong in all alike:
where motions begin right, they begin alike. What is tried begins along what known views, small and blurred, differ by
most, so that neighbours begin as neighbours; each view by itself might be led to the wrong side of others. A budget
that is too short for all of them has fewer, and the last one fewer layers. Layered textures read through a homography
are the multi-plane images of Zhou et al. 2018 and Wizadwongsa et al. 2021 (NeX), which know the cameras.

Textures can learn the known views by heart under a wrong motion, above all if there are few views. The motion is
therefore also held to the known views themselves: what a view shows at a pixel should be found where the motion
takes it in a view nearby (as in Zhou et al. 2017, who learn depth so). On a turntable light and shade stay behind when
the rest turns; there what is around each pixel is compared without its brightness and contrast. Of few pictures a view
between two is held to both in the same way, since nothing else says what there should be.

What the layers leave over of each known view (sharp detail, highlights that slide over a surface) is kept as that
view's remainder, read where the motion takes it, and shared among the known views nearest in motion.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from viinter.fields.field import Field
from viinter.fields.maps import around, look_up, normalized, pyramid, read, robust, sample, stretch

MOST = 100, 300  # steps at each of the coarse levels, and at half size
LEAST = 10, 15  # the same in short budgets, unless they take more than these shares of it until they are finished:
LATEST = 0.40, 0.65
ENOUGH = 1500, 60  # steps, and passes over the known pixels: after both more time only learns known views by heart
FEWEST = 30  # steps for each layer of all sets: a budget in seconds should be enough for so many, or has fewer sets
USUAL = 4, 4  # layers of a set, and sets
DEEP = 8, 2  # the same for photographs by hand, which take as long; found by trial (docs/fast_tried.md)
STEP = 4.5  # drawings of its pixels that a training step takes as long as
EDGE = 20.0  # for each unit of rgb: how fast a step of colour lets the disparity step too
NEAREST = 8  # known views that share in a remainder
COMPARED = 4  # one of so many pieces of a batch is looked up in another known view
PARTNERS = 4  # which is one of so many nearest in motion, in turns
FEW = 4  # known views at most, if mixes of their codes are held to them too, motions begin at random, sets not `DEEP`
GOLDEN = 40_503  # of 65,536, the golden section: its multiples, less whole parts, spread evenly (Weyl 1916)
DOUBT = 9  # pixels: within twice as many it is judged how far known views are apart
JUDGED = 8  # one of so many rows of the known views says how much each set counts
ALONG = 3, 0.1  # motions begin along so many directions at least, and all with this share of the first one's variance
ASIDE = 0.2  # times as much as these any other counts once disparities are maps; found by trial (docs/fast_tried.md)
PHASES = (0, 0), (0.5, 0.5), (0.5, 0), (0, 0.5)  # pixels, of sets in turns: how their textures lie against each other
LOST = 1.03  # times the least error of a set: more, and the set takes the motion of the one that has it
RECENT = 0.1  # share of the last batch in the errors by which that is judged
TRIED = 20  # steps of trials, if with the least of the first level they seem to fit into its share when they begin
WARM = 5  # steps until which they begin, or not at all
SPARE = 2  # times the layers that a field has, in sets of the usual number, are tried


class Pace(NamedTuple):
    """How a field goes from coarse to fine, found by trial (docs/fast_tried.md).

    `coarsest`: pixels of a view's shorter side at the first level, where no motion between views should be far.
    `coarse`, `half`: shares of the budget after which the levels coarser than half size are finished, and that of half
    size. `shift`, `bend`: rates of the motion, and of its polynomials but the constant one.
    """

    coarsest: int
    coarse: float
    half: float
    shift: float
    bend: float


STEADY = Pace(32, 0.12, 0.30, 0.1, 0.025)  # views near one another, many to each layer


class FastField(Field):
    """F(xy | z) -> rgb from `sets` of `layers` textures each, for `views` known views of `height` x `width`.

    Coarse to fine: colours and weights are sums of levels, each twice as fine as the one before. `at(progress)` chooses
    the level in training; those before it are kept as they are, those after it do not take part. A level's weights have
    half the size of its colours; the finest level has none of its own and trains those of the level before.
    `normalize`: known views are compared as they are `normalized`. `doubts`: known views lie in a row, and how far each
    is from those beside it, where the motion takes it, is kept with its remainder (`judged`). `tries`: twice as many
    layers first try motions (`attempt`), in a field of their own of one level, which is a `trial`: its layers move as
    wholes. See `config.FastModel` for the other arguments.
    """

    def __init__(self, code_dim: int, views: int, height: int, width: int, layers: int, sets: int, motion: int,
                 margin: float, texture_pixels: int, sharpness: float, entropy: float, smooth: float,
                 consistency: float, remainder: bool, pace: Pace = STEADY, normalize: bool = False,
                 doubts: bool = False, tries: bool = True, trial: bool = False) -> None:  # fmt: skip
        super().__init__()
        self.held: Tensor | None = None  # the penalty of the last call, and what it was made of
        self.drawn: tuple[Tensor, ...] = ()
        self.known: Tensor | None = None
        self.beginning: tuple[Tensor, Tensor] | None = None
        self.maps: tuple[Tensor, Tensor] | None = None
        self.kept: dict[str, tuple[list, Tensor]] = {}
        self.margin, self.sharpness, self.motion, self.pace = margin, sharpness, motion, pace
        self.entropy, self.smooth, self.consistency, self.normalize = entropy, smooth, consistency, normalize
        self.doubts, self.trial = doubts, trial
        self.pitch = 2 / width
        self.sets, self.layers = sets, layers
        layers *= sets  # those of a set one after the other
        self.reductions = reductions(height, width, texture_pixels, pace.coarsest)
        sizes = [(round(height * margin / by), round(width * margin / by)) for by in self.reductions]
        count = len(sizes)
        self.colours = nn.ParameterList(torch.zeros(layers, 3, max(2, h), max(2, w)) for h, w in sizes)
        halves = [(max(4, h // 2), max(4, w // 2)) for h, w in sizes]
        self.weights = nn.ParameterList(torch.zeros(layers, 1, *half) for half in halves[: max(1, count - 1)])
        self.delta = nn.Parameter(torch.zeros(layers, 2, *halves[max(0, count - 2)]))
        spread = (torch.linspace(-1, 1, layers) if layers > 1 else torch.zeros(1)).view(-1, sets).T
        spread = torch.cat([spread[:, ::2], spread[:, 1::2]], 1)  # the first half of a set's layers goes as far as all
        self.disparity = nn.Parameter(spread.flatten())
        self.shift = nn.Parameter(0.02 * torch.randn(sets, 6, code_dim) / math.sqrt(code_dim))
        self.bend = nn.Parameter(torch.zeros(sets, 4 * (motion - 1), code_dim))
        self.register_buffer("gain", torch.ones(()))
        # half precision: a remainder is small, and a scene's memory should stay near that of its images
        shape = (views, 3 + doubts, height, width) if remainder else (0, 3, 1, 1)
        self.register_buffer("remainder", torch.zeros(shape, dtype=torch.float16))
        self.register_buffer("places", torch.zeros(shape[0], sets, 4 * motion + 2))
        self.register_buffer("trust", torch.ones(sets))  # shares of the sets in what is drawn, once finished
        phases = torch.tensor([PHASES[number % len(PHASES)] for number in range(sets)])
        self.register_buffer("phase", phases * 2 / torch.tensor(sizes[-1]).flip(0))  # [S, 2]
        self.register_buffer("errors", torch.ones(sets))  # of late, of each set while its motion is found
        self.register_buffer("finished", torch.zeros((), dtype=torch.bool))
        self.register_buffer("span", None)  # [M, r]: orthonormal, what of a code the motion begins with (`unfold`)
        self.register_load_state_dict_pre_hook(FastField._loads)
        self.level = count - 1
        self.trials, self.tried, self.trying = None, 0, False
        self.register_buffer("attempts", torch.zeros(2, dtype=torch.long))  # `tried` and `trying`, for a checkpoint
        if tries and count > 1:
            first = (motion, margin, 0, sharpness, 0.0, 0.0, 0.0, False, pace)  # of no pixels: the first level alone
            self.trials = FastField(code_dim, 0, height, width, *tried(layers), *first, trial=True)
        # what changes from step to step is on the device, where a CUDA graph can read it, and so is what is constant
        self.register_buffer("step", torch.zeros((), dtype=torch.long), persistent=False)
        self.register_buffer("decision", torch.ones(()), persistent=False)
        self.register_buffer("size", torch.tensor([[width], [height]]).float(), persistent=False)

    def see(self, views: Tensor, codes: Tensor) -> None:
        """Holds the known views [n, H, W, 3] that `penalty` compares and `unfold` asks, and no copy of them, until
        `finish`."""
        self.known, self.maps = views if len(views) > 1 and self.consistency else None, None
        self.beginning = (views, codes.detach().clone()) if len(views) > FEW else None

    @torch.no_grad()
    def unfold(self, views: Tensor, codes: Tensor) -> None:
        """Has the trials begin with motions that are linear in the `principal` coordinates of the known views
        [n, H, W, 3] with codes [n, M], at the size of the first level; keeps the `span` of the codes that says these.

        A view changes smoothly with its camera (the eigenspace of Murase and Nayar 1995), and blurred so much nearly in
        proportion: the coordinates of a light field are its grid. From random beginnings each view finds its own way,
        and whole rows of them may end up on the wrong side of their neighbours. So only the span moves anything until
        disparities are maps, and what else a code has less than that from then on.
        """
        small = F.avg_pool2d(views.movedim(-1, 1).to(self.shift.dtype), self.reductions[0]).flatten(1)
        places = principal(small)[:, : codes.shape[1]]
        says = torch.linalg.pinv((codes * self.gain).double().cpu()) @ places
        self.span = self.trials.span = torch.linalg.qr(says).Q.to(self.shift)
        shift = self.trials.shift
        random = shift[..., : places.shape[1]] * math.sqrt(codes.shape[1])
        shift.copy_(random @ says.T.to(shift))

    @torch.no_grad()
    def hold(self) -> None:
        """Takes from the motion what an optimiser put outside the `span`."""
        if self.span is not None:
            for field in self._both():
                for own in (field.shift, field.bend):
                    own.copy_(self._inside(own))

    def _inside(self, codes: Tensor) -> Tensor:
        """What of `codes` [..., M] lies in the `span`."""
        return codes @ self.span @ self.span.T

    def calibrate(self, codes: Tensor) -> None:
        """Takes the codes' Euclidean scale out, once, so that norm and radius of the codes [n, M] do not matter."""
        for field in self._both():
            field.gain.copy_(1 / codes.detach().norm(dim=-1).mean().clamp_min(1e-12))

    def parameter_groups(self, codes: nn.Parameter) -> list[dict[str, Any]]:
        """Textures, disparity maps, and three groups that move: what is far from 1 in `share` was found by trial."""
        both = self._both()
        return [
            {"params": [maps for field in both for maps in (*field.colours, *field.weights)], "share": 1.0},
            {"params": [field.delta for field in both], "share": 0.5},
            {"params": [own for field in both for own in (field.shift, field.disparity)], "share": self.pace.shift},
            {"params": [field.bend for field in both], "share": self.pace.bend},
            {"params": [codes], "share": 2.5 / self.gain.item()},
        ]

    def _both(self) -> list[FastField]:
        """The field, and its trials if it has any."""
        return [self] if self.trials is None else [self, self.trials]

    def rates(self) -> list[float]:
        """Whatever moves the textures slows down with the size of their pixels."""
        moves = 0.5**self.level
        return [1.0, 1.0, moves, moves, moves]

    def at(self, progress: float, step: int = 0) -> None:
        """Chooses the level in training for the share of the budget that is used, in [0, 1], and the step.

        `Pace` lays the levels over the budget, the finest with most of it, but none before that has more steps than
        `MOST`: textures that are finished before the motion is known hold it where it is. In a short budget they have
        a larger share, for `LEAST` steps: until the motion is about right finer textures learn nothing. Where the first
        level has time for it motions are tried before (`attempt`), and these steps count for no level. The penalty on
        mixed weights is faded in over the finest level's first part: a decision made then is often wrong too.
        """
        self.finished.fill_(False)
        if self.training and not self.mapped():
            self.hold()
        count = len(self.colours)
        coarse, a_step = max(0, count - 2), progress / step if step else 0.0  # that is its share of the budget
        least = LEAST[0] * coarse, LEAST[0] * coarse + LEAST[1]
        early, half = (
            max(usual, min(steps * a_step, latest))
            for usual, steps, latest in zip((self.pace.coarse, self.pace.half), least, LATEST, strict=True)
        )
        ends = [early * (k + 1) / coarse for k in range(coarse)] + [half, 1.0]
        most = [MOST[0] * (k + 1) for k in range(coarse)] + [MOST[0] * coarse + MOST[1], math.inf]
        if self.training:
            self.attempt(step, (TRIED + LEAST[0]) * a_step <= ends[-count])
        share, steps = progress - self.tried * a_step, step - self.tried
        stages = zip(ends[-count:], most[-count:], strict=True)
        level = next((k for k, (end, last) in enumerate(stages) if share < end and steps < last), count - 1)
        if level != self.level:
            self.kept.clear()
            self.maps = None
        self.level = level
        if self.sets > 1 and self.training and not self.mapped():
            self.regain()
        self.step.fill_(step)
        self.decision.fill_(min(max((share - half) / 0.3, 0.0), 1.0))

    def stage(self) -> int:
        return -1 if self.trying else self.level

    @torch.no_grad()
    def attempt(self, step: int, affordable: bool) -> None:
        """Has the `trials` trained in place of the sets for `TRIED` steps, and then gives the sets their best motions.
        Pixels lead from each beginning to another motion, and which is the best shows early, but not at once. How they
        begin: `unfold`.

        They begin as soon as they are `affordable`, and then go on. The first step tells nothing of the budget, and in
        seconds some more take longer than all others.
        """
        was, self.tried = self.trying, self.tried if step else 0
        begins = affordable and 0 < step <= WARM
        self.trying = self.trials is not None and self.tried < TRIED and (was or begins)
        if self.trying and not was and self.beginning is not None:
            self.unfold(*self.beginning)
        self.tried += self.trying
        if was or self.trying or not step:
            for own, value in zip(self.attempts, (self.tried, self.trying), strict=True):
                own.fill_(value)
        if was and not self.trying and step:
            order = self.trials.recent().argsort()
            best = order[torch.arange(self.sets, device=order.device) % len(order)]
            for own, found in ((self.shift, self.trials.shift), (self.bend, self.trials.bend)):
                own.copy_(found.index_select(0, best))

    def recent(self) -> Tensor:
        """The sets' errors of late [S], of all processes: each has seen pixels of its own."""
        errors = self.errors.clone()
        if torch.distributed.is_initialized():
            torch.distributed.all_reduce(errors)
        return errors

    @torch.no_grad()
    def regain(self) -> None:
        """Gives sets that are `LOST` the motion of the best. One that went wrong on the coarse levels stays wrong, and
        its set would have no voice in the end; with layers of its own it makes of the same motion another picture.

        All on the device, which need not be waited for.
        """
        errors = self.recent()
        lost, best = errors > LOST * errors.min(), errors.argmin()[None]
        for own in (self.errors, self.shift, self.bend):
            own.copy_(torch.where(lost.view(-1, *[1] * (own.dim() - 1)), own.index_select(0, best), own))

    @staticmethod
    def _loads(field: FastField, state: dict[str, Any], prefix: str, *_: Any) -> None:
        """Leaves as many sets and layers as the field has that the `state` is of, which may be an older one."""
        if {f"{prefix}shift", f"{prefix}disparity"} <= set(state):
            sets = max(1, len(state[f"{prefix}shift"]))
            field._leave(sets, len(state[f"{prefix}disparity"]) // sets)
            state.setdefault(f"{prefix}errors", field.errors)
            state.setdefault(f"{prefix}phase", torch.zeros_like(field.phase))  # once they lay alike
            if f"{prefix}span" in state:
                field.span = torch.zeros_like(state[f"{prefix}span"], device=field.shift.device)
            if f"{prefix}trials.shift" not in state:
                field.trials = None
            field.tried, trying = state.setdefault(f"{prefix}attempts", field.attempts).tolist()
            field.trying = bool(trying)

    def _leave(self, sets: int, layers: int) -> None:
        """Drops all but the first sets, and of them all but the first layers. What stays are the same parameters: an
        optimiser may hold them already."""
        if (sets, layers) == (self.sets, self.layers):
            return
        for maps in (*self.colours, *self.weights, self.delta, self.disparity):
            maps.data = maps.data.unflatten(0, (self.sets, self.layers))[:sets, :layers].flatten(0, 1).clone()
        for own in (self.shift, self.bend, self.trust, self.phase, self.errors):
            own.data = own.data[:sets].clone()
        self.places = self.places[:, :sets].clone()
        self.sets, self.layers = sets, layers
        self.kept.clear()
        if self.trials is not None:
            layers, sets = tried(layers * sets)
            self.trials._leave(sets, layers)

    def textures(self) -> Tensor:
        """Colours and weights [S L, 4, h, w] of the layers at the level in training.

        What stays the same from call to call is kept: while one level is trained the sum of those before it, and in
        evaluation, where no gradient is asked for, all of it.
        """
        colours, weights = (list(maps)[: self.level + 1] for maps in (self.colours, self.weights))
        if not self.training and not torch.is_grad_enabled():
            return self._kept("drawn", [*colours, *weights], lambda: self._together(pyramid(colours), pyramid(weights)))
        return self._together(self._trained("colours", colours), self._trained("weights", weights))

    @staticmethod
    def _together(colours: Tensor, weights: Tensor) -> Tensor:
        return torch.cat([colours, stretch(weights, colours)], 1)

    def _trained(self, name: str, levels: list[Tensor]) -> Tensor:
        *before, last = levels
        return self._kept(name, before, lambda: stretch(pyramid(before), last).detach()) + last if before else last

    def _kept(self, name: str, of: list[Tensor], make: Callable[[], Tensor]) -> Tensor:
        """What `make()` gave the last time, if the tensors `of` that it is made of are the same since.

        A fused optimiser changes weights without counting it in their `_version`: see `at` and `train`. In a CUDA
        graph it is made each time: the graph would not know of another.
        """
        if of[0].is_cuda and torch.cuda.is_current_stream_capturing():
            return make()
        now = [(t.data_ptr(), t._version, t.dtype) for t in of]
        was, found = self.kept.get(name, (None, None))
        if was != now:
            found = make()
            self.kept[name] = now, found
        return found

    def train(self, mode: bool = True) -> FastField:
        self.kept.clear()
        return super().train(mode)

    def place(self, z: Tensor) -> Tensor:
        """The motion's coefficients [V, S, 4 K + 2] under the codes `z` [V, M]: a_k and b_k of every polynomial, c."""
        whole, difference, other = self.shift.split(2, 1)
        across = torch.stack([-whole[:, 1], whole[:, 0]], 1)
        matrix = torch.cat([whole, whole + difference, self.bend, across + other], 1)
        z = z * self.gain
        if self.span is not None:
            z = torch.lerp(self._inside(z), z, ASIDE if self.mapped() else 0.0)
        return F.linear(z, matrix.flatten(0, 1)).unflatten(1, matrix.shape[:2])

    def basis(self, xy: Tensor) -> Tensor:
        """The polynomials phi [V, K, P] at the pixels `xy` [V, 2, P]: planes, with which products are ten times as
        fast on a CPU as with pixels that hold their K or 2 numbers together."""
        x, y = xy.unbind(1)
        return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y][: self.motion], 1)

    def carry(self, phi: Tensor, place: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The motions a and b [S, V, 2, P] and c [S, V, 2, 1], in units of a texture, from `basis` and `place`."""
        polynomials, c = (place / self.margin).split([4 * self.motion, 2], 2)
        motion = polynomials.unflatten(2, (self.motion, 4)).transpose(2, 3)
        a, b = (motion.flatten(1, 2) @ phi).unflatten(1, motion.shape[1:3]).transpose(0, 1).split(2, 2)
        return a, b, c.transpose(0, 1)[..., None]

    def forward(self, xy: Tensor, z: Tensor) -> Tensor:
        """Colours [V, P, 3] of the pixels `xy` [V, P, 2] in [-1, 1) under the codes `z` [V, M]; not clamped.

        In mixed precision too everything is done in the precision of the parameters: a motion rounded to bfloat16
        would be wrong by parts of a pixel, and there are no matrix products that would gain.
        """
        return self.judged(xy, z)[0]

    def judged(self, xy: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """As `forward`, and how far the known views around were apart there, where the motion took them: the root of
        the mean square in rgb [V, P, 1], once finished and if the field `doubts`; until then 0 []."""
        with torch.autocast(xy.device.type, enabled=False):
            return self._colours(xy.to(self.shift.dtype).transpose(1, 2).contiguous(), z.to(self.shift.dtype))

    def _colours(self, xy: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """As `judged`, from `xy` [V, 2, P]."""
        if self.trying:
            return self.trials._colours(xy, z)
        place, phi = self.place(z), self.basis(xy)
        each, weight, seen = self.each_set(xy, phi, place)
        # asked only in evaluation: on a GPU the answer must be waited for
        finished = not self.training and bool(self.finished)
        mean = self.mean(each) if finished else each.mean(0)
        if self.training and torch.is_grad_enabled():
            self.drawn = xy, phi, place, seen, each.detach()
            undecided = (1 - weight.square().sum(1)).mean()
            self.held = (each - mean).square().mean() + self.decision * self.entropy * undecided
            self.held = self.held + self.smooth * self.roughness(xy, seen, each)
        rgb, doubt = mean.movedim(0, -1) + 0.5, xy.new_zeros(())
        if finished and len(self.remainder):
            left, doubt = self.left_over(xy, phi, place, seen).tensor_split([3], -1)
            rgb = rgb + left
        return rgb, doubt

    def mapped(self) -> bool:
        """Whether disparities and drifts are maps yet, or each layer still moves as a whole."""
        return not self.trial and self.level >= min(2, len(self.colours) - 1)

    def each_set(self, xy: Tensor, phi: Tensor, place: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What each set shows at `xy` [V, 2, P] with `basis` and `place`: its colour less 0.5 [S, 3, V, P], its layers'
        weights [S, L, V, P], and its disparity and drift [S, 2, V, P]."""
        a, b, c = (part[:, None] for part in self.carry(phi, place))  # [S, 1, V, 2, P]
        disparity = self.disparity.view(self.sets, self.layers, 1, 1)
        u = xy / self.margin + self.phase.view(-1, 1, 1, 2, 1) + a
        u = torch.addcmul(u, disparity[..., None], b)  # [S, L, V, 2, P]
        drift = None
        if self.mapped():
            delta, drift = read(self.delta, u).unbind(2)
            u, disparity = torch.addcmul(u, delta[:, :, :, None], b), disparity + delta
            # a product of matrices, since c is the same for all pixels: its gradient is a sum over them
            c = c.expand(-1, self.layers, -1, -1, -1).flatten(0, 2)
            u = torch.baddbmm(u.flatten(0, 2), c, drift.flatten(0, 2)[:, None]).view(u.shape)
        colour, weight = read(self.textures(), u).split([3, 1], 2)
        weight = torch.softmax(self.sharpness * weight, 1)
        each, weight = (weight * colour).sum(1), weight.squeeze(2)
        disparity = (weight * disparity).sum(1)
        drift = torch.zeros_like(disparity) if drift is None else (weight * drift).sum(1)
        return each, weight, torch.stack([disparity, drift], 1)

    def roughness(self, xy: Tensor, seen: Tensor, colour: Tensor) -> Tensor:
        """How much disparity and drift `seen` [S, 2, V, P] differ between pixels that lie side by side, less where
        `colour` [S, 3, V, P] does too (as in Godard et al. 2017). Of pixels drawn at random few lie so, of pieces
        of rows nearly all."""
        beside = xy.diff(dim=-1).abs().sum(1) < 1.5 * self.pitch
        edge = torch.exp(-EDGE * colour.detach().diff(dim=-1).abs().mean(1))
        return (seen.diff(dim=-1).abs().sum(1) * edge * beside).sum() / seen[:, 0].numel()

    def disagreement(self, view: Tensor, rgb: Tensor, codes: Tensor) -> Tensor:
        """How far colours `rgb` [V, P, 3] of the pixels drawn last, of known views number `view` [V], are from those
        that other known views have where the sets' motion takes these pixels; `codes` [n, M] are the known views'.

        Each view is compared with one of those nearest to it in motion, with another at each step, and at the size of
        the level in training. Of few known views, a mix with that one is drawn too and held to both.
        """
        xy, phi, place, seen, _ = self.drawn
        some = torch.arange(max(len(view) // COMPARED, 1), device=xy.device) * COMPARED + self.step % COMPARED
        some %= len(view)
        view, rgb, xy, phi, place = (part.index_select(0, some) for part in (view, rgb, xy, phi, place))
        seen, places = seen.index_select(2, some), self.place(codes)
        with torch.no_grad():
            distances = torch.cdist(places.flatten(1), places.flatten(1)).fill_diagonal_(math.inf)
            near = distances.topk(min(PARTNERS, len(codes) - 1), largest=False).indices
        partner = near[view, (self.step // COMPARED % near.shape[1])[None]]
        _, maps = self._maps()
        there, inside = self.found(maps, partner, places, xy, phi, place, seen)
        as_drawn = self.reductions[self.level] == 1 and not self.normalize
        own = rgb if as_drawn else look_up(maps, view, self._pixel(xy))
        apart = (robust((there - own).square().mean(-1)) * inside).mean()
        return apart + self.between(view, partner, xy, phi, places) if len(codes) <= FEW else apart

    def between(self, view: Tensor, partner: Tensor, xy: Tensor, phi: Tensor, places: Tensor) -> Tensor:
        """How far what each set shows at `xy` [V, 2, P] of a view between the known views number `view` and `partner`
        [V], at `places` [n, S, 4 K + 2], is from what the better of these two has where the motion takes it: what one
        of them does not see the other mostly does (as in Godard et al. 2019)."""
        share = (self.step * GOLDEN % 65_536 / 65_536).to(places.dtype)
        place = torch.lerp(places.index_select(0, view), places.index_select(0, partner), share)
        each, _, seen = self.each_set(xy, phi, place)
        each, errors, (maps, _) = each.movedim(1, -1) + 0.5, [], self._maps()
        for known in (view, partner):
            there, inside = self.found(maps, known, places, xy, phi, place, seen)
            errors.append((there - each).square().mean(-1).masked_fill(~inside, math.inf))
        error = torch.minimum(*errors)
        return robust(error.masked_fill(error.isinf(), 0)).mean()

    def found(self, maps: Tensor, known: Tensor, places: Tensor, xy: Tensor, phi: Tensor, place: Tensor,
              seen: Tensor) -> tuple[Tensor, Tensor]:  # fmt: skip
        """What [S, V, P, 3] the known views number `known` [V] of those at `places` [n, S, 4 K + 2], one of `_maps`,
        have where the motion takes the pixels `xy` [V, 2, P] of views at `place` [V, S, 4 K + 2] with what is `seen`
        [S, 2, V, P] there; and whether that is inside the view [S, V, P]."""
        a, b, c = self.carry(phi, place - places.index_select(0, known))
        disparity, drift = seen[..., None, :].unbind(1)
        moved = self.margin * torch.addcmul(torch.addcmul(a, disparity, b), drift, c)  # [S, V, 2, P]
        there = self._pixel(xy + moved)
        x, y = there.unbind(2)
        inside = (x >= 0) & (x <= maps.shape[2] - 1) & (y >= 0) & (y <= maps.shape[1] - 1)
        return look_up(maps, known, there), inside

    def _pixel(self, xy: Tensor) -> Tensor:
        """Where `xy` [..., 2, P] lies in the known views at the size of the level, counted in their pixels."""
        return ((xy + 1) * self.size / 2 + 0.5) / self.reductions[self.level] - 0.5

    def _sized(self, views: Tensor) -> Tensor:
        """Views [n, H, W, 3] at the size of the level in training."""
        by = self.reductions[self.level]
        return F.avg_pool2d(views.movedim(-1, 1), by).movedim(1, -1).contiguous() if by > 1 else views

    def _maps(self) -> tuple[Tensor, Tensor]:
        """The known views [n, h, w, 3] at the size of the level in training, and what of them is compared; the same
        memory until the level changes."""
        if self.maps is None:
            maps = self._sized(self.known.to(self.shift.dtype))
            self.maps = maps, normalized(maps) if self.normalize else maps
        return self.maps

    def loss(self, view: Tensor, xy: Tensor, rgb: Tensor, codes: Tensor) -> Tensor:
        """The mean squared error, and the `penalty`; each set's own error goes into `errors`, by which it may `regain`
        its motion."""
        if self.trying:
            return self.trials.loss(view, xy, rgb, codes)
        loss = super().loss(view, xy, rgb, codes)
        if self.sets > 1 and not self.mapped():
            *_, each = self.drawn
            error = (each.movedim(1, -1) + 0.5 - rgb).square().flatten(1).mean(1)
            self.errors.lerp_(error.to(self.errors.dtype), RECENT)
        return loss + self.penalty(view, rgb, codes)

    def penalty(self, view: Tensor, rgb: Tensor, codes: Tensor) -> Tensor:
        """Four terms on the pixels of the last call.

        How far the sets lie apart, which added to the error of their mean is the mean of their own errors (Krogh and
        Vedelsby 1995). How undecided pixels were between layers: the mean of 1 - sum_l w_l^2, weighted.
        `roughness`, weighted: where nothing is seen to move, any disparity would do for the known views, but not
        between them. And `disagreement`, weighted, once the field has seen the known views and disparities are maps:
        before, with sets whose layers move as a whole, it sometimes held a motion that was still wrong.
        """
        held, self.held = self.held, None
        if self.known is not None and self.mapped():
            with torch.autocast(rgb.device.type, enabled=False):
                held = held + self.consistency * self.disagreement(view, rgb.to(self.shift.dtype), codes)
        self.drawn = ()
        return held

    def enough(self, steps_per_pass: float) -> float:
        steps, passes = ENOUGH
        return max(steps, passes * steps_per_pass)

    def settle(self, seconds: float, views: int, batch: float, drawing: Callable[[], float]) -> float:
        """Halves the sets, and then the last one's layers down to the usual, until the budget is enough for `FEWEST`
        steps for each layer: in too few of them many sets learn less than one that has all the time to itself. Where
        processes train together all stay: they have agreed on the parameters' sizes."""
        took, alone = drawing(), not torch.distributed.is_initialized()
        enough = seconds / (FEWEST * STEP * batch)
        while alone and (self.sets > 1 or self.layers > USUAL[0]) and enough < self.sets * self.layers * took:
            if self.sets > 1:
                self._leave((self.sets + 1) // 2, self.layers)
            else:
                self._leave(1, max(USUAL[0], self.layers // 2))
            took = drawing()
        return views * took * (1 / JUDGED + bool(len(self.remainder)))

    @torch.no_grad()
    def finish(self, views: Tensor, codes: Tensor) -> None:
        """Settles how much each set counts (`best_shares` of the errors at the known views), and keeps what the layers
        leave over of the known views [n, H, W, 3] with codes [n, M]."""
        _, height, width, _ = views.shape
        views, codes = views.movedim(-1, 1).to(self.shift.dtype), codes.to(self.shift.dtype)
        was = self.training
        self.eval()
        x, y = (-1 + 2 * torch.arange(size).to(views) / size for size in (width, height))

        def shown(code: Tensor, rows: slice) -> tuple[Tensor, tuple[Tensor, ...]]:
            """What each set shows of some rows of a view, [S, 3, h, W], and at which pixels with which motion."""
            xy = torch.stack(torch.meshgrid(x, y[rows], indexing="xy")).flatten(1)[None]
            phi, place = self.basis(xy), self.place(code[None])
            each, _, seen = self.each_set(xy, phi, place)
            return each[:, :, 0].unflatten(2, (-1, width)) + 0.5, (xy, phi, place, seen)

        some, many = slice(None, None, JUDGED), max(1, 65_536 // width)
        pairs = list(zip(views, codes, strict=True))
        covariance = torch.zeros(self.sets, self.sets).double()
        for view, z in pairs:
            errors = (shown(z, some)[0] - view[:, some]).flatten(1)
            covariance += (errors @ errors.T).cpu() / errors.numel()
        self.trust.copy_(best_shares(covariance))
        if len(self.remainder):
            self.places.copy_(self.place(codes))
            maps = self._sized(views.movedim(1, -1)) if self.doubts else None
            for number, (own, (view, z)) in enumerate(zip(self.remainder, pairs, strict=True)):
                for rows in (slice(k, k + many) for k in range(0, height, many)):
                    each, drawn = shown(z, rows)
                    own[:3, rows] = view[:, rows] - self.mean(each)
                    if self.doubts:
                        own[3, rows] = self.apart(number, maps, *drawn).view(-1, width)
            if self.doubts:
                self.remainder[:, 3:] = around(self.remainder[:, 3:].to(views), DOUBT).sqrt()
        self.finished.fill_(True)
        # nothing is compared any more, and whoever keeps the field need not keep them
        self.known = self.maps = self.beginning = None
        self.train(was)

    def apart(self, number: int, maps: Tensor, xy: Tensor, phi: Tensor, place: Tensor, seen: Tensor) -> Tensor:
        """The mean squared difference [P] of the known view `number` at `xy` from the known views beside it in the row,
        where the motion takes it (`found`)."""
        at = torch.tensor([number], device=xy.device)
        own, errors = look_up(maps, at, self._pixel(xy)), []
        for beside in {max(number - 1, 0), min(number + 1, len(maps) - 1)} - {number}:
            there, _ = self.found(maps, at + beside - number, self.places, xy, phi, place, seen)
            errors.append(self.mean((there - own).square().mean(-1))[0])
        return sum(errors) / len(errors)

    def mean(self, each: Tensor) -> Tensor:
        """The sets' mean of `each` [S, ...], each set by its trust."""
        return torch.tensordot(self.trust, each, 1)

    def shares(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """How much each of the `N` known views nearest to `place` [V, S, 4 K + 2] gives of its remainder: [V, N],
        summing to 1, and which views these are, [V, N].

        A known view's share falls with its distance in motion, and is all of it at its own place; it is gone at the
        distance of the first view that is left out, so that a view enters and leaves a path without a jump (Shepard's
        interpolation, as Franke and Nielson 1980 made it local).
        """
        trust = self.trust[:, None]
        place, known = (trust * place).flatten(1), (trust * self.places).flatten(1)
        apart = torch.cdist(place, known, compute_mode="donot_use_mm_for_euclid_dist")  # that would be inexact
        apart = apart.clamp_min(1e-6)  # two views may be at one place
        apart, views = apart.topk(min(NEAREST + 1, apart.shape[1]), largest=False)
        if apart.shape[1] > NEAREST:
            near = (1 / apart - 1 / apart[:, -1:])[:, :-1]
            near, views = near.clamp_min(1e-12), views[:, :-1]  # all views may be at one distance
        else:
            near = 1 / apart
        near = near**1.5
        return near / near.sum(-1, keepdim=True), views

    def left_over(self, xy: Tensor, phi: Tensor, place: Tensor, seen: Tensor) -> Tensor:
        """The known views' remainders [V, P, 3 or 4] at `xy` [V, 2, P] of views at `place`, where the sets with what is
        `seen` [S, 2, V, P] of disparity and drift see them on average, each by its trust."""
        shares, views = self.shares(place)
        apart = self.trust[:, None] * (place[:, None] - self.places[views])
        polynomials, c = apart.split([4 * self.motion, 2], 3)
        a, b = polynomials.unflatten(3, (self.motion, 4)).split(2, 4)  # [V, N, S, K, 2]
        weights = torch.cat([a.sum(2), b.flatten(2, 3), c], 2).transpose(2, 3)
        disparity, drift = seen.movedim(2, 0).unbind(2)
        scaled = (disparity[:, :, None] * phi[:, None]).flatten(1, 2)
        scale = self.size / (self.size - 1).clamp_min(1)  # pixel centres at both ends, as grid_sample counts
        motion = (scale * weights).flatten(1, 2) @ torch.cat([phi, scaled, drift], 1)
        there = ((xy + 1) * scale - 1)[:, None] + motion.unflatten(1, (-1, 2))  # [V, N, 2, P]
        total = xy.new_zeros(len(xy), self.remainder.shape[1], xy.shape[-1])
        for share, view, at in zip(shares.unbind(1), views.unbind(1), there.unbind(1), strict=True):
            own = sample(self.remainder[view].to(at.dtype), at[:, None])[:, :, 0]
            total.addcmul_(share[:, None, None], own)
        return total.movedim(1, -1)


def reductions(height: int, width: int, texture_pixels: int, coarsest: int = STEADY.coarsest) -> list[int]:
    """How many times smaller than a view the textures of each level are: powers of 2, from that which brings a view's
    shorter side to about `coarsest` pixels to the least that brings the view to `texture_pixels` at most."""
    most = max(0, math.ceil(math.log2(min(height, width) / coarsest)))
    return [2**k for k in range(most, -1, -1) if k == most or height * width <= texture_pixels * 4**k]


def tried(layers: int) -> tuple[int, int]:
    """Layers of a set, and sets, that are tried for a field of so many `layers` in all."""
    return USUAL[0], max(SPARE, SPARE * layers // USUAL[0])


def principal(points: Tensor) -> Tensor:
    """Coordinates [n, r] of `points` [n, D] along their principal directions (Pearson 1901), `ALONG` of n - 1 at most,
    with a mean square of 1 a point; in double precision, on the CPU."""
    least, share = ALONG
    points = points.double().cpu()
    u, sizes, _ = torch.linalg.svd(points - points.mean(0), full_matrices=False)
    count = max(least, int((sizes.square() >= share * sizes[0].square()).sum()))
    places = (u * sizes)[:, : min(count, len(points) - 1)]
    return places / places.square().sum(1).mean().sqrt().clamp_min(1e-12)


def best_shares(covariance: Tensor) -> Tensor:
    """Shares [S] of S guesses, none negative and summing to 1, with which their mean has the least squared error, from
    the `covariance` [S, S] of their errors (Bates and Granger 1969). What all have in common, noise of what they guess
    for one, makes no difference. Guesses whose share would be negative are left out, the worst first.
    """
    steady = 1e-3 * covariance.diagonal().mean() + 1e-12  # alike guesses get alike shares
    covariance = covariance + steady * torch.eye(len(covariance)).to(covariance)
    shares, left = torch.zeros_like(covariance[0]), torch.arange(len(covariance))
    while len(left):
        own = torch.linalg.solve(covariance[left][:, left], torch.ones_like(shares[left]))
        if (own >= 0).all():
            shares[left] = own / own.sum()
            break
        left = left[own > own.min()]
    return shares
