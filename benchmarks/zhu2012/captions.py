"""The text of docs/results.md beside its tables and figures."""

from __future__ import annotations

INTRODUCTION = """\
The tables and figures of the two papers that Paceline implements, on rendered scenes with exact truth, written by
`make results`. Every item names the command that measures it alone, and how long that takes; all numbers are in
[results.json](results.json), and the commands read and write `build/results`. The commands of [Zhu] render their clips
first, once, which takes 30 to 70 processor seconds for each; for that they need the extra `simulation`:
`.venv/bin/pip install -e ".[simulation]"`. No clip and no seed was chosen by
its result; two scenes of [NIST] were made harder until they showed the effects of shadows and weaving. The accuracy of
Paceline over many clips is in [accuracy.md](accuracy.md).

[Zhu] is J. Zhu, L. Yuan, Y. F. Zheng, R. L. Ewing, "Stereo Visual Tracking Within Structured Environments for
Measuring Vehicle Speed", 2012; [NIST] is H. Schneiderman, M. Nashman, R. Lumia, "Model-based vision for car
following", 1993. Their recordings are not published: the scenes here have their speeds, frame rates, picture sizes
and baselines ([simulation.md](simulation.md)), but are other clips, so numbers can be compared in kind, not digit
by digit.

*As printed* is the paper's particle filter alone: its dynamics are the only proposal, and the drawn road line is a
hard constraint. *Refined* is what `paceline speed` reports. *Drawn without error* gives the filter the true outline and
the true path in place of an operator's clicks (σ 0.5 px for corners, 0.4 px for the line). Speeds are in mph, as in
the paper."""

HEADINGS = {
    "table-1a": "## [Zhu]: the tables",
    "figures-5-6": "## [Zhu]: the figures",
    "nist-target": "## [NIST]",
}

_FIGURE = """\
Green is the estimate, red the truth, blue the particles. In the table an error "frame by frame" counts from the
second estimated speed on; the depth beside a refined speed is that of the filter before it."""

_DISPARITIES = """\
The last row shows the disparities by which the multimodal particles are weighted: the lighter the nearer, blue where
the two views do not match."""

CAPTIONS = {
    "table-1a": """\
Averages and maximum errors are those of the last frame over 20 seeds; the first guess is 10 % low. Drawn without
error the averages are the paper's, and the maximum error falls with the number of particles as there, but stays
two to four times as large. Drawn by an operator the same filter is more than 1 mph low, whatever the number of
particles: see [the effect of the operator's noise](#effect-of-the-operators-noise-on-these-tables). The refined speed
is a little too fast here, with and without that noise. The cause are specular reflections: with matte paint the same
car is measured within 0.01 mph ([method.md](method.md#refinement)). Over many clips with flat fronts the same
refinement has 0.03 mph root mean square ([accuracy.md](accuracy.md)).""",
    "table-1b": """\
200 particles, as in the paper. Its steep gain from 4 to 10 parts does not show: the averages differ by less than the
maximum errors, and 4 parts are hardly worse than 10. In the picture the centre is as near with 4 parts as with 10
([figure 7](#zhu-figure-7-parts-of-the-likelihood)), so the localisation that the paper lost with large parts is
not lost here.""",
    "table-2a": """\
The first guess is 20 % low: the paper says "much lower" and no more. As in the paper the averages are low and rise
with the number of particles; unlike there some runs settle on a wrong speed even with 800, so that the maximum errors
stay at several mph. `paceline speed`'s own filter, which moves its particles by registration, has no such run.""",
    "table-2b": """\
400 particles. More noise lets the speed leave the low first guess, so the averages rise. The maximum errors grow with
it as in the paper where an operator drew; drawn without error the runs that settle on a wrong speed outweigh it.""",
    "operator-noise": """\
400 particles, 20 seeds, the refinement once. On the straight road the outline is the cause: its two views together
give a depth that is 3 m short ([figure 6](#zhu-figures-5-and-6-straight-road-55-mph), right), and a filter under a
hard constraint turns a share of missing depth into the same share of missing speed. The road line adds nothing on this
clip; on others it does ([benchmarks](../benchmarks/README.md), `path_constraint.py`). The refined
speed hardly depends on them.""",
    "first-guess": """\
400 particles, drawn without error, 20 seeds; all else as in Tables I(a) and II(a). On the winding road the first guess
explains that the average is low: begun at the true speed it is right. The single runs far off stay.""",
    "figures-5-6": f"""{_FIGURE} {_DISPARITIES}

800 particles. With the path the particles stay close together and the speed steady; without it both are wider, as in
the paper. SIFT and the Kalman filter over it scatter as there, and the multimodal particles drift off the front.
Unlike there the constrained filter ends low, by the outline's error. The refined speed falls during the track,
though the true one is constant. `lucas-kanade` keeps the depth error of the outline; its speed does not need it.""",
    "figure-7": "200 particles, one seed. All three stay on the front; none is lost.",
    "figures-8-9": f"""{_FIGURE}

200 particles. The operator's line of this scene runs nearly along the epipolar lines and is refused with one plain
line, so outline and path are the true ones here. As in the paper the speed settles at once, slightly low, and the
angular velocity with it. The baselines lose the turning front after a few frames; no speed of theirs is shown.""",
    "figures-10-11": f"""{_FIGURE} {_DISPARITIES}

400 particles, a first guess 12 % low (the paper's was more than 10 % off). The filter settles within two frames,
about 1 mph low;
the multimodal particles drift and jump as there, and their speed is rejected as too uncertain. What lies beside the
front has nearly its disparity, so that depth does not hold the outline where it is, as in the paper.""",
    "figures-12-13": f"""{_FIGURE}

400 particles, seed 0: one of the runs of Table II(a) that settle on a wrong speed. The error of its depth is of the
same kind, and the angular velocity is that of the drawn curve at that wrong place. The refined speed is not affected:
it begins with Paceline's own filter.""",
    "figures-14-15": f"""{_FIGURE}

400 particles each, both begun at 55 mph. Both filters leave the wrong first guess within a few frames, as in the
paper. The refined speed of the left vehicle misses its interval, as on the straight road above; the other holds
it.""",
    "figures-16-15": f"""{_FIGURE}

400 particles. On a straight path the paper's particles have no lateral freedom: that filter stays on the path
while the vehicle leaves it. "Drifting" (shown in the pictures) takes the line as a curve, on which they have σ_P =
0.1 m a frame, as the paper did here. It follows both changes, with a degraded speed, as
there. The refinement takes swerving as one more model and measures both.""",
    "nist-stages": """\
Grey is where the last frame's estimate was, blue and orange are edge points near the vertical and the horizontal,
then one colour per feature for the accepted points.""",
    "nist-long": """\
The camera's vehicle drives itself, at 15 pictures a second and with 128 ms from picture to steering
([driving.md](driving.md)); the paper's 17 minutes were a video tape.""",
    "nist-failures": """\
Red is the published method, green all remedies, in the last frame before the published method fails and five and nine
frames later. The middle part of the table adds one remedy at a time to the published method, the last part takes one
away. Alone the wide search, adaptive decay and polarity help most; from the whole the wide search and the
predicted gates are missed most. On these few clips continuity, the check of polarity, the appearance and
the snapshot cost 10 to 14 frames of 450 under strong shadows and save none; their benefit is shown in
[benchmarks](../benchmarks/README.md), `follow_ablation.py`.""",
    "nist-decay": """\
The published method with one decay for all three parameters, beside the present one. *Abrupt motion* is a lead
that weaves by 2.5 m, *shadows* are dense and dark. The paper's trade-off shows: a long memory loses the weaving
vehicle, a short one follows the shadows. What the last row loses is the first two seconds of a saloon
whose start is in doubt.
In a first version the camera was shaken instead; there every decay lost most frames,
since a bump's velocity does not last, and no trade-off showed.""",
    "nist-rate": """\
256 × 242 pixels, rendered beforehand, then tracked one after the other. Wall clock from picture to steering angle, so
what else the machine did meanwhile is in it, above all in the slowest frames.""",
}
