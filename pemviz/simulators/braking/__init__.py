"""The braking scenario, exactly: what both back ends step, and what another one would have to.

An ego car follows a lead car on a straight road. Both start at the speed v_0, the gap between
them is gap_0; then the lead car brakes. Symbols stand for the fields of
:class:`pemviz.config.ScenarioConfig`, whose defaults are the preset ``paper``: v_0 =
``initial_speed_kmh``, 70 km/h; gap_0 = ``initial_gap_m``, 15 m; dt = ``dt_s``, 0.05 s; T =
``states``, 100.

**Rollout.** T states s_0 to s_{T-1}, and T - 1 outcomes of perception at s_0 to s_{T-2}. A state
is the ``gap`` [m] from the ego's windscreen camera to the rear of the lead car, the speeds
``ego_speed`` and ``lead_speed`` [m/s], its index t, and what the ego's speed controller remembers,
the integral I [m] of its speed error, 0 at s_0. Contact does not change the dynamics: the gap may
go below 0.

**One step**, from s_t and the outcome at s_t to s_{t+1}:

1. *Perception.* detected ~ Bernoulli(p), p the error model's for the salient variables at s_t.
2. *Emergency braking rule* (``scenario.py``). Emergency, if detected and gap <
   ``emergency_gap_m`` (10 m).
3. *Ego's acceleration.* In an emergency -``emergency_deceleration_mps2`` (8 m/s^2), and I is held.
   Otherwise a PI controller (PID with K_d = 0) drives to v_0: e = v_0 - ego_speed; first I grows
   by e dt; then a = K_p e + K_i I with K_p = ``speed_gain_per_s`` (1 /s) and K_i =
   ``speed_integral_gain_per_s2`` (0.05 /s^2), at least -``maximum_deceleration_mps2`` (3 m/s^2)
   and at most ``maximum_acceleration_mps2`` (1 m/s^2).
4. *Lead car's acceleration.* -``lead_deceleration_mps2`` (2.943 m/s^2, 0.3 g) if t dt is at least
   ``lead_brake_time_s`` (0 s), else 0.
5. *Positions, with the old speeds* (explicit Euler): gap grows by (lead_speed - ego_speed) dt.
6. *Speeds:* each grows by its acceleration times dt, and is 0 if that is negative: a car that
   would reverse stands.

**Position errors** (``pemviz/simulators/measurement_errors.py``; none unless asked for). In rule 2
the gap is then the one that perception measures: gap + e, e the error along the line of sight of
the lead car's centre, a function of its salient variables and a standard normal u_t. With the error
model's share c and memory time tau, u_t = sqrt(c) s + sqrt(1 - c) a_t; s is sampled once, a_0 =
z_0, and a_t = rho a_{t-1} + sqrt(1 - rho^2) z_t with rho = exp(-dt/tau). s and the z_t are the
rollout's latents.

**Salient variables** of the lead car at a state, as KITTI would label it, in the order of
``pemviz.pem.SALIENT_COLUMNS``: class Car, truncation 0, occlusion 0 (none), alpha -pi/2, height
1.53 m, width 1.63 m, length ``lead_length_m`` (5 m), x = 0, y = ``camera_height_m`` (1.65 m), z =
gap + length / 2 (KITTI locates a car by its centre), rotation_y -pi/2 (heading away).

**Specification:** ``always[0,99] (gap >= 2.0)``, the presets' own. The agm metric normalises the
gap by plus and minus ``gap_bound_m`` (25 m), speeds by 0 to ``speed_bound_mps`` (40 m/s).

**Preset** ``town01``: as ``paper``, but v_0 = 30 km/h, the lead car brakes at 8 m/s^2, and the
controller's upper limit is 2 m/s^2.

**Limits:** no false positives, misses independent given the state, one obstacle. The braking of
both cars is this project's choice, since the paper (Innes & Ramamoorthy, arXiv 2209.09674) does
not give it.

Given the same outcomes the back ends agree to 1e-9: ``vectorized`` (a batch of rollouts at once)
and ``highway-env`` (the library's own road and vehicles, a rollout at a time).
"""
