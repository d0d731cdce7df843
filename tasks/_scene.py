"""What the pictures of several tasks share: sky, checkered ground and light, as MJCF. Nothing here can be touched."""

FLOOR = '<geom name="floor" type="plane" size="0 0 5" material="ground" contype="0" conaffinity="0"/>'


def scene(ground: tuple[str, str] = ("0.78 0.80 0.82", "0.64 0.68 0.72"), sky: str = "0.86 0.91 0.96") -> str:
    """Write the sections `visual` and `asset`; colours are "red green blue" from 0 to 1."""
    return f"""
  <visual>
    <headlight ambient="0.4 0.4 0.4" diffuse="0.25 0.25 0.25" specular="0 0 0"/>
    <quality shadowsize="4096"/>
    <map shadowclip="2"/>
  </visual>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1="{sky}" rgb2="1 1 1" width="32" height="192"/>
    <texture name="ground" type="2d" builtin="checker" width="128" height="128" rgb1="{ground[0]}" rgb2="{ground[1]}"/>
    <material name="ground" texture="ground" texuniform="true" texrepeat="1 1" specular="0" shininess="0"/>
  </asset>"""
