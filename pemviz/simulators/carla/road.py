"""A straight road for CARLA to make a world of, in OpenDRIVE 1.4."""

from pemviz.config import ScenarioConfig

ROAD_ID, LANE_ID = 1, -1
LANE_WIDTH_M = 3.5
BEFORE_M, BEYOND_M = 30.0, 150.0
"""Before the ego's place at the start, and beyond what two cars at the initial speed cover."""


def road_length_m(config: ScenarioConfig, *, lead_in_s: float) -> float:
    """How long the road has to be [m].

    Args:
        config: The scenario.
        lead_in_s: For how long both cars drive before the scenario begins.
    """
    driven_s = lead_in_s + config.states * config.dt_s
    return BEFORE_M + config.initial_gap_m + config.initial_speed_mps * driven_s + BEYOND_M


def road_text(length_m: float) -> str:
    """OpenDRIVE of one straight road along x, a lane each way.

    Args:
        length_m: Above 0.
    """
    lanes = "".join(
        f"""
      <{side}><lane id="{number}" type="driving" level="false">
        <width sOffset="0" a="{LANE_WIDTH_M}" b="0" c="0" d="0"/></lane></{side}>"""
        if number
        else """
      <center><lane id="0" type="none" level="false"/></center>"""
        for side, number in (("left", 1), ("center", 0), ("right", LANE_ID))
    )
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<OpenDRIVE>
  <header revMajor="1" revMinor="4" name="pemviz" version="1.00"/>
  <road name="straight" length="{length_m:.17g}" id="{ROAD_ID}" junction="-1">
    <link/>
    <planView>
      <geometry s="0" x="0" y="0" hdg="0" length="{length_m:.17g}"><line/></geometry>
    </planView>
    <elevationProfile><elevation s="0" a="0" b="0" c="0" d="0"/></elevationProfile>
    <lanes><laneSection s="0">{lanes}
    </laneSection></lanes>
  </road>
</OpenDRIVE>
"""
