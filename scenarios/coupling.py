"""A component in Python for two_fmus.yaml: a shaft that twists, between two machines."""

from exlinn_fmi import PythonComponent, Variable


class SpringDamper(PythonComponent):
    """Torques of a massless elastic shaft on the machines at its ends."""

    variables = (
        Variable("angle_left", "input", unit="rad", start=0.0),
        Variable("angle_right", "input", unit="rad", start=0.0),
        Variable("speed_left", "input", unit="rad/s", start=0.0),
        Variable("speed_right", "input", unit="rad/s", start=0.0),
        Variable("stiffness", "parameter", "tunable", unit="N.m/rad", start=10.0, min=0.0),
        Variable("damping", "parameter", "tunable", unit="N.m.s/rad", start=0.2, min=0.0),
        *(
            Variable(
                name,
                "output",
                unit="N.m",
                depends_on=("angle_left", "angle_right", "speed_left", "speed_right"),
            )
            for name in ("torque_left", "torque_right")
        ),
    )

    def outputs(self, t: float) -> None:
        """Spring and damper pull the two ends together."""
        twist = self["angle_right"] - self["angle_left"]
        slip = self["speed_right"] - self["speed_left"]
        torque = self["stiffness"] * twist + self["damping"] * slip
        self["torque_left"] = torque
        self["torque_right"] = -torque
