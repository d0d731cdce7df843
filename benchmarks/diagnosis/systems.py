"""Robots of the diagnosis benchmark, from primitives."""

from bayessim_mjx.blind.reality.system import System


def _model(name: str, timestep: float, worldbody: str, actuator: str) -> str:
    return f"""<mujoco model="{name}">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="{timestep}" integrator="implicitfast"/>
  <default><geom type="capsule" contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="base"><geom name="base" type="box" size=".06 .06 .04" mass="3"/>
{worldbody}
    </body>
  </worldbody>
  <actuator>
{actuator}
  </actuator>
</mujoco>
"""


def _chain(links: list[tuple]) -> str:
    """Nested bodies: (body, joint, axis, position, end of the capsule, radius, mass, damping, armature)."""
    text, close = "", ""
    for depth, (body, joint, axis, pos, end, radius, mass, damping, armature) in enumerate(links):
        pad = "  " * (depth + 3)
        text += (
            f'{pad}<body name="{body}" pos="{pos}">\n'
            f'{pad}  <joint name="{joint}" axis="{axis}" damping="{damping}" armature="{armature}"/>\n'
            f'{pad}  <geom name="{body}" fromto="0 0 0 {end}" size="{radius}" mass="{mass}"/>\n'
        )
        close = f"{pad}</body>\n" + close
    return text + close


def _motors(joints: list[str], limits: list[float]) -> str:
    return "\n".join(
        f'    <motor name="{j}_motor" joint="{j}" ctrlrange="-{u} {u}"/>' for j, u in zip(joints, limits, strict=True)
    )


def _pendulum() -> System:
    links = [("link", "hinge", "0 1 0", "0 0 0", "0 0 -.4", ".02", 0.6, 0.02, 0.006)]
    xml = _model("pendulum", 0.005, _chain(links), _motors(["hinge"], [4.0]))
    return System("pendulum", xml, 0.02, False, (6.0,), (0.5,), (0.6,), (1.0,), 0.5, (4e-4,))


def _cartpole() -> System:
    body = """      <body name="cart">
        <joint name="slider" type="slide" axis="1 0 0" damping=".6" armature=".15"/>
        <geom name="cart" type="box" size=".08 .05 .04" mass=".8"/>
        <body name="pole">
          <joint name="pole" axis="0 1 0" damping=".004" armature=".001"/>
          <geom name="pole" fromto="0 0 0 0 0 -.5" size=".015" mass=".3"/>
        </body>
      </body>"""
    motor = '    <motor name="slider_motor" joint="slider" ctrlrange="-20 20"/>'
    xml = _model("cartpole", 0.005, body, motor)
    return System(
        "cartpole", xml, 0.02, False, (60.0,), (10.0,), (0.0,), (0.25,), 0.45, (3e-4, 5e-4), push=0.1, tilts=False
    )


def _two_link() -> System:
    links = [
        ("upper", "shoulder", "0 1 0", "0 0 0", "0 0 -.3", ".025", 1.0, 0.06, 0.02),
        ("lower", "elbow", "0 1 0", "0 0 -.3", "0 0 -.25", ".02", 0.6, 0.03, 0.01),
    ]
    xml = _model("two_link", 0.005, _chain(links), _motors(["shoulder", "elbow"], [12.0, 5.0]))
    return System("two_link", xml, 0.01, False, (40.0, 14.0), (3.0, 1.0), (0.7, 0.6), (0.8, 0.9), 0.5, (3e-4, 4e-4))


_JOINTS6 = ["waist", "shoulder", "elbow", "roll", "pitch", "flange"]


def _links6() -> str:
    return _chain(
        [
            ("column", "waist", "0 0 1", "0 0 .1", "0 0 .2", ".06", 3.0, 0.5, 0.25),
            ("upper_arm", "shoulder", "0 1 0", "0 0 .2", "0 0 .35", ".045", 2.5, 0.5, 0.25),
            ("forearm", "elbow", "0 1 0", "0 0 .35", ".3 0 0", ".04", 1.5, 0.3, 0.12),
            ("wrist1", "roll", "1 0 0", ".3 0 0", ".08 0 0", ".035", 0.6, 0.06, 0.03),
            ("wrist2", "pitch", "0 1 0", ".08 0 0", ".08 0 0", ".03", 0.4, 0.06, 0.03),
            ("tool", "flange", "1 0 0", ".08 0 0", ".06 0 .03", ".025", 0.3, 0.03, 0.015),
        ]
    )


_REST6 = (0.0, 0.4, 0.4, 0.3, 0.5, 0.2)
_SWING6 = (0.7, 0.5, 0.6, 0.8, 0.7, 0.9)
_SIGMA6 = (3e-4,) * 3 + (4e-4,) * 3


def _arm_servo() -> System:
    gains = zip(_JOINTS6, (400, 400, 250, 60, 60, 25), (40, 40, 20, 4, 4, 1.5), strict=True)
    servos = "\n".join(f'    <position name="{j}_servo" joint="{j}" kp="{kp}" kv="{kv}"/>' for j, kp, kv in gains)
    xml = _model("arm_servo", 0.005, _links6(), servos)
    return System("arm_servo", xml, 0.01, True, (), (), _REST6, _SWING6, 0.45, _SIGMA6)


def _arm_torque() -> System:
    limits = [40.0, 60.0, 30.0, 8.0, 8.0, 4.0]
    xml = _model("arm_torque", 0.005, _links6(), _motors(_JOINTS6, limits))
    kp = (150.0, 200.0, 110.0, 20.0, 20.0, 8.0)
    kd = (20.0, 25.0, 12.0, 2.0, 2.0, 0.8)
    return System("arm_torque", xml, 0.01, False, kp, kd, _REST6, _SWING6, 0.45, _SIGMA6, push=0.12)


def _leg() -> System:
    links = [
        ("hip_link", "abduction", "1 0 0", "0 0 0", "0 .08 0", ".04", 0.7, 0.05, 0.02),
        ("thigh", "hip", "0 1 0", "0 .08 0", "0 0 -.2", ".025", 1.0, 0.05, 0.02),
        ("shank", "knee", "0 1 0", "0 0 -.2", "0 0 -.2", ".015", 0.25, 0.03, 0.015),
    ]
    joints = ["abduction", "hip", "knee"]
    xml = _model("leg", 0.005, _chain(links), _motors(joints, [15.0, 15.0, 8.0]))
    kp, kd = (30.0, 30.0, 12.0), (2.0, 2.0, 0.8)
    return System("leg", xml, 0.01, False, kp, kd, (0.0, 0.5, -0.9), (0.5, 0.7, 0.8), 0.7, (4e-4,) * 3)


def _foot() -> System:
    """A leg whose foot slides on the floor under load and, in large motions, leaves it."""
    links = [
        ("thigh", "hip", "0 1 0", "0 0 0", "0 0 -.2", ".025", 1.0, 0.1, 0.02),
        ("shank", "knee", "0 1 0", "0 0 -.2", "0 0 -.2", ".015", 0.25, 0.1, 0.015),
    ]
    xml = _model("crouch", 0.002, _chain(links), _motors(["hip", "knee"], [15.0, 15.0]))
    foot = 'type="sphere" size=".02" pos="0 0 -.2" mass=".03" friction=".8 .005 .0001"'
    floor = '<geom name="floor" type="plane" size="2 2 .1" pos="0 0 -.35" friction=".3 .005 .0001"'
    touch = ' contype="1" conaffinity="1"/>'
    shank = xml.index('<geom name="shank"')
    after = xml.index("/>", shank) + 2
    xml = xml[:after] + f'\n          <geom name="foot" {foot}{touch}' + xml[after:]
    xml = xml.replace('    <body name="base">', f'    {floor}{touch}\n    <body name="base">')
    kp, kd = (40.0, 30.0), (2.0, 1.5)
    return System("foot", xml, 0.01, False, kp, kd, (0.5, -1.0), (0.25, 0.3), 0.7, (4e-4,) * 2, push=0.1, lift=-0.2)


SYSTEMS = {s.name: s for s in (_pendulum(), _cartpole(), _two_link(), _arm_servo(), _arm_torque(), _leg(), _foot())}
