"""Logical scenarios, exactly: what every back end steps, and what another one would have to.

Highway driving's three critical situations, as UN Regulation No. 157 names them: a lead car that
brakes (``braking``), a car that cuts in (``cut-in``), a lead car that leaves the lane and reveals a
slower one (``cut-out``). An answer is per encounter. Words in ``typewriter`` are fields of
:class:`pemviz.config.EncounterConfig` or start values; t counts states, dt = ``dt_s``, L =
``car_length_m``, W = ``car_width_m``, w = ``lane_width_m``, s = 1 with ``side`` left and -1 with
right.

**Frame.** x along the road, y to the left; the ego keeps to y = 0 with heading 0. Three lanes with
centres -w, 0, w. Cars are rectangles along the road, L by W, whatever their heading.

**Start values** are sampled once: ``pemviz/config/encounters.py`` names them by logical scenario
with their default distributions. One with a fixed number takes no latent; the others take one each,
in that order, mapped by their quantile function. Speeds and decelerations below 0 are taken as 0, a
``duration`` below dt as dt.

**Other cars**, each a slot, in this order. A gap is from bumper to bumper along the road: gap_k =
x_k - x_ego - L; aside_k = y_k. At the start, with V = ``ego_speed``, and speeds at least 0:

- ``braking``: *lead*, gap ``gap``, speed V - ``closing_speed``, y = 0; decelerates by
  ``deceleration`` at every step with t dt >= ``brake_time``.
- ``cut-in``: *cutting_in*, speed V - ``closing_speed``, y from s w to 0, beginning at
  ``cut_in_time``, within ``duration``; gap at s_0 ``gap`` + min(``closing_speed``, V)
  (``cut_in_time`` + u ``duration``) with S(u) = max(w - W, 0) / (2 w), so that it is ``gap`` when
  its near side is at the lane marking if the ego keeps its speed; *lead*, ``lead_gap`` + L farther
  ahead, speed V, y = 0.
- ``cut-out``: *lead*, gap ``gap``, speed V - ``closing_speed``, y from 0 to s w, beginning at
  ``cut_out_time``, within ``duration``; *revealed*, speed ``revealed_speed``, y = 0, gap ``gap``
  + L + max(V_lead - ``revealed_speed``, 0) (``cut_out_time`` + u ``duration`` + ``margin``) with
  S(u) = min(W / w, 1): ``margin`` is how long before it would touch it the lead car has its side
  clear of the revealed car's.
- with ``neighbour``, last, in all: *neighbour*, gap ``neighbour_gap``, speed V, y = -s w.

They do not react to each other; the default distributions keep them apart.

**A ghost**, with ``ghost_probability`` above 0: a place that perception may take for a standing car
although nothing is there, such as a bridge's shadow or a manhole cover. It lies in the ego's lane,
its gap ``ghost_gap`` at s_0 and ``ghost_gap`` - x_ego from then on, y = 0, speed and heading 0. It
is a slot, *ghost*, after those of all cars, whose nominal outcome is False: nothing is reported.
The error model says nothing of it: where it may appear it is reported with ``ghost_probability`` at
a step, which with a memory hangs together as misses do, its share in all being the same. No car
touches it, it hides none, and rules know nothing of it.

**Position errors** (``position_errors``; none by default) are those of
``pemviz.pem.models.position_errors``, with salient variables as below, at the states s_0 to
s_{T-2}, for every slot, the ghost too. With b = atan2(x, z) its bearing (below), e_r the error
along the line of sight and e_c the one across it, to the right: gap_k + e_r cos b - e_c sin b and
aside_k - e_r sin b - e_c cos b are measured. The noise u of an error is, with its memory's share c
and time tau, sqrt(c) l + sqrt(1 - c) f_t: l is sampled once, f_0 is standard normal, f_t = r
f_{t-1} + sqrt(1 - r^2) times a standard normal with r = exp(-dt / tau). Latents at every step: for
each slot one for e_r, then one for e_c; at the start, after those of start values and only if the c
of one kind is above 0, the l in the same order. A third kind of error, of speed, is not used.

**Lateral profile.** Y(time) = y_from + (y_to - y_from) S((time - begin) / duration), with the
minimum jerk S(u) = 10 u^3 - 15 u^4 + 6 u^5, 0 below u = 0 and 1 above 1 (Flash & Hogan 1985).

**Rollout.** T = ``states`` states s_0 to s_{T-1}, T - 1 outcomes for each slot, at s_0 to s_{T-2}.
The ego starts at x = 0 with speed V, its set speed.

**One step**, from s_t and its outcomes to s_{t+1}:

1. *Perception.* Slot k is a hit if it is present (below) and detected; the ghost, if it is present
   and reported. A hit measures gap_k, aside_k and closing_k = v_ego - v_k cos(heading_k); of the
   ghost that is ``ghost_gap`` - x_ego, 0 and v_ego. With position errors (below) gap_k and aside_k
   are off, closing_k is not.
2. *Tracker* (``scenario.tracker``; ``pemviz.simulators.tracking``), positions (gap, aside). Without
   one the ego is told of the hits alone. With one it is told of confirmed tracks: position the
   track's; closing speed by a filter that has speeds minus the track's along the first axis,
   otherwise that of the last hit.
3. *Ego's acceleration.* a_0 = ``speed_gain_per_s`` (V - v_ego). Each car that it is told of, with
   gap g, aside y and closing speed c, and which is in its path, |y| - W / 2 <
   ``path_half_width_m`` and g + L > 0, asks for
   a_k = ``gap_gain_per_s2`` (g - ``standstill_gap_m`` - ``time_gap_s`` v_ego) -
   ``closing_gain_per_s`` c. a is the least of a_0 and all a_k, at least
   -``maximum_deceleration_mps2`` and at most ``maximum_acceleration_mps2``. But with B =
   ``hard_deceleration_mps2``, a = -B if for one of them c > 0 and
   g < c (c / (2 B) + ``hard_reserve_s``): its time to collision g / c is too small. a is at least
   -v_ego / dt, and 0 from contact on.
4. *Others' acceleration:* -``deceleration`` where the list above says so, else 0.
5. *Positions, with the old speeds and headings* (explicit Euler): x grows by v cos(heading) dt, y
   by v sin(heading) dt.
6. *Speeds:* each grows by its acceleration times dt, and is 0 if that is negative.
7. *Contact* (``vectorized.py``), unless there was one. With dx = x_k - x_ego and dy = y_k, old and
   new ones joined by straight lines over the step's share f from 0 to 1, car k touches the ego at
   the least f with |dx| <= L and |dy| <= W. The ego and the car with the least f of all (the first
   in order, if several) are put where they are at that f, with speed 0: there they stay.
   ``collided`` is 1 from then on, ``impact_speed`` the length of the step's (dx, dy), new minus
   old, over dt.
8. *Headings:* of car k at s_t with speed v > 0, arcsin((Y((t+1) dt) - y_k) / (v dt)), the argument
   kept within +-0.3; a car that stands keeps its heading, 0 at s_0. A car is thereby where its
   profile has it at every state, unless it is too slow for that.

**Signals.** ``ego_x`` [m], ``ego_speed`` [m/s], ``ego_acceleration`` [m/s^2] (a of the step that
led here; 0 at s_0); of each other car ``gap_NAME``, ``aside_NAME`` [m], ``speed_NAME`` [m/s],
``heading_NAME`` [rad], which are its slot's, and the same four of the ghost, after all cars';
``collided``, ``impact_speed`` [m/s]; ``clearance`` [m], the least over the other cars of max(|dx| -
L, |dy| - W), 0 at contact; and what rules ask for:

- A car is *ahead in lane* if |aside| < (w + W) / 2 and gap + L > 0; its *safe distance* is
  max(0, (v_ego^2 - u^2) / (2 B) + ``reaction_time_s`` v_ego), u = v_k cos(heading_k): what is left
  if both brake by B, the ego that much later (Shalev-Shwartz et al. 2017; Maierhofer et al. 2020).
- ``safe_distance`` [m]: gap minus safe distance of the nearest car ahead in lane (the first in
  order, if several are), if it is the one at s_t and at the n states before, n =
  ``recovery_time_s`` / dt rounded down; what the ego meets at s_0 counts as having just come, and
  so does a car that another one no longer hides. Otherwise ``gap_bound_m``, and always within +-
  that.
- ``needless_deceleration`` [m/s^2], of the step that led here: 0 if at its beginning a car ahead in
  lane was nearer than its safe distance, otherwise how much harder the ego braked than the nearest
  one ahead in lane (or than 0, without one), at least 0; 0 at s_0.
- ``avoidable_by`` [s], with ``cut-in`` only: -10 until the state at which the near side of
  *cutting_in* has come 0.3 m beyond the lane marking, |aside| - W / 2 <= w / 2 - 0.3, having been
  short of that at the state before; from then on, with c its closing speed and g its gap there, g /
  c - (c / (2 * 6 m/s^2) + 0.35 s), within +-10; 10 if c <= 0; -10 if its lateral movement was to be
  seen for less than 0.72 s by then, t dt < ``cut_in_time`` + 0.72 s. That is the regulation's own
  line (UN R157, 5.2.5.2): above 0 a collision has to be avoided.

From contact on the last three stay what they were at the state before.

**Camera**, ``camera_to_bumper_m`` behind the ego's front bumper, ``camera_height_m`` above the
road, looking ahead (``sight.py``). Of car k: near end z_1 = gap_k + ``camera_to_bumper_m``, far end
z_2 = z_1 + L, centre z = z_1 + L / 2, x = -aside_k to the right. In the image it reaches from the
least to the greatest of (x +- W / 2) / z over its two ends, z_1 taken as 0.5 m if it is less. What
is beyond +-tan(``camera_half_angle_deg``) is *truncated*; of the rest, what other cars whose z_1 is
less (of equals: the one earlier in order) and whose z is above 0.5 m cover is *occluded*, from side
to side: heights are left out. A slot is *present* if 0.5 m < z <= ``farthest_m``, its truncated
share is below 1 and its occluded share is below 0.9. The *ghost* is present, that is, may appear,
if 0.5 m < z <= ``farthest_m`` and no car ahead in lane has a smaller gap.

**Salient variables** of a slot, of the ghost those of a car there that nothing covers, in the order
of ``pemviz.pem.SALIENT_COLUMNS``: class Car; truncation the truncated share; occlusion 0 (none) for
an occluded share below 0.1, 1 (partly) below 0.5, else 2 (largely); alpha rotation_y - atan2(x, z);
``car_height_m``, W, L; x; y = ``camera_height_m``; z; rotation_y -pi/2 - heading_k.

**Rules** of the presets: ``no-collision``, clearance - collided >= 0 at all states;
``safe-distance``, safe_distance >= 0 (Maierhofer et al. 2020, R_G1); ``no-unnecessary-braking``,
needless_deceleration <= 6 m/s^2 (R_G2, for hard braking; an ego that is told of nothing but cars
that are there, where they are, keeps it); ``avoidable-cut-in``, with ``cut-in``: at no state both
avoidable_by > 0 and a contact.

**Where the numbers come from.** The mean of ``duration`` is 4.6 s and its standard deviation 2.2 s,
as Toledo & Zohar 2007 found lane changes on a motorway; bounds of comfortable acceleration and
deceleration are those of adaptive cruise control at 20 m/s and above (ISO 15622); the camera's
angle is that of KITTI's. All else, gaps, speeds, times and decelerations above all, is this
project's choice of what is ordinary on a motorway (cut-out: at its lower speeds), cut at both ends
so that an ego that misses nothing avoids a collision: not fitted to recorded traffic. Whoever has
recordings gives their own distributions.

**Limits:** other cars keep their speed and do not react; one ghost at a fixed place; measured
speeds have no errors; the ego does not steer.
"""
