"""One rollout of a kept run as a file for other tools: tables, OpenSCENARIO, CommonRoad."""
