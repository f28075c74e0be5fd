# SPDX-License-Identifier: Apache-2.0
"""Small models in every format that `import_robot` reads."""

MJCF = """<mujoco model="own">
  <compiler angle="radian"><lengthrange mode="none"/></compiler>
  <worldbody>
    <body name="base" pos="0 0.1 1" euler="0.2 0 0.1">
      <geom type="sphere" size="0.02" mass="1"/>
      <site name="o1" pos="0.06 0 0"/> <site name="o2" pos="-0.06 0.01 0"/>
      <site name="o3" pos="0.01 0.06 0.01"/> <site name="o4" pos="0.01 -0.06 0.01"/>
      <body name="upper" pos="0 0 -0.02">
        <joint name="swing" axis="0 1 0" range="-1 1.2" pos="0 0 0.01" ref="0.2" limited="true"/>
        <joint name="lift" axis="1 0.1 0" range="-0.6 0.6" limited="true"/>
        <geom name="ball" type="sphere" size="0.03" mass="0.4"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="1"/>
        <site name="u1" pos="0.04 0 -0.12"/> <site name="u2" pos="-0.04 0 -0.12"/>
        <site name="u3" pos="0 0.05 -0.12"/> <site name="u4" pos="0 -0.05 -0.12"/>
        <site name="side" pos="-0.06 0 -0.3"/>
        <geom name="drum" type="cylinder" size="0.025 0.05" pos="0 0 -0.3" euler="1.57 0 0.1"
              mass="0.01"/>
        <body name="lower" pos="0 0 -0.3">
          <joint name="elbow" axis="0 1 0" range="-1.8 0.2" limited="true"/>
          <geom type="capsule" fromto="0 0 0 0 0 -0.25" size="0.015" mass="0.7"/>
          <site name="l1" pos="0.035 0 -0.08"/> <site name="l2" pos="-0.03 0.01 -0.06"/>
          <body name="finger" pos="0 0 -0.25">
            <joint name="curl" axis="0 1 0" range="-2 2" limited="true"/>
            <geom type="capsule" fromto="0 0 0 0 0 -0.05" size="0.01" mass="0.1"/>
            <site name="f1" pos="0.015 0 -0.02"/> <site name="f2" pos="-0.015 0 -0.02"/>
            <site name="hole" pos="0 0 0"/>
            <geom name="ring" type="sphere" size="0.012" mass="0.001"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="curl" joint2="elbow" polycoef="0.1 0.5 0 0 0"/></equality>
  <tendon>
    <spatial name="front"><site site="o1"/><geom geom="ball"/><site site="u1"/></spatial>
    <spatial name="back"><site site="o2"/><geom geom="ball"/><site site="u2"/></spatial>
    <spatial name="out"><site site="o3"/><site site="u3"/></spatial>
    <spatial name="in"><site site="o4"/><site site="u4"/></spatial>
    <spatial name="bend"><site site="u1"/><site site="l1"/></spatial>
    <spatial name="stretch">
      <site site="u2"/><geom geom="drum" sidesite="side"/><site site="l2"/></spatial>
    <spatial name="curler">
      <site site="l1"/><geom geom="ring" sidesite="hole"/><site site="f1"/></spatial>
    <fixed name="none"><joint joint="elbow" coef="1"/></fixed>
  </tendon>
  <actuator>
    <muscle name="m1" tendon="front" force="90" gear="2"/>
    <muscle name="m2" tendon="back" force="150"/>
    <muscle name="m3" tendon="out" force="150"/><muscle name="m4" tendon="in" force="150"/>
    <muscle name="m5" tendon="bend" force="200"/><muscle name="m6" tendon="stretch" force="200"/>
    <muscle name="m7" tendon="curler" force="50"/><motor name="not" joint="elbow"/>
  </actuator>
</mujoco>
"""

#: a finger beside an obstacle, whose centre of mass is on the axes of its joints
TOUCHING = """<mujoco><default><geom margin=".002"/></default>
  <worldbody><geom name="obstacle" type="box" size=".01 .05 .1" pos=".035 0 -.1"/>
    <site name="a" pos=".02 0 .05"/><site name="b" pos="-.02 0 .05"/>
    <site name="c" pos="0 .02 .05"/><site name="d" pos="0 -.02 .05"/>
    <body name="finger"><joint name="spread" axis="1 0 0" range="-20 20" damping=".05"
        armature=".0001"/><joint name="bend" axis="0 1 0" range="-60 60" damping=".05"
        armature=".0001"/><inertial pos="0 0 0" mass=".01" diaginertia="1e-5 1e-5 1e-5"/>
      <geom type="capsule" fromto="0 0 -.02 0 0 -.1" size=".01"/>
      <site name="e" pos=".02 0 -.05"/><site name="f" pos="-.02 0 -.05"/>
      <site name="g" pos="0 .02 -.05"/><site name="h" pos="0 -.02 -.05"/></body></worldbody>
  <tendon><spatial name="out"><site site="a"/><site site="e"/></spatial>
    <spatial name="in"><site site="b"/><site site="f"/></spatial>
    <spatial name="left"><site site="c"/><site site="g"/></spatial>
    <spatial name="right"><site site="d"/><site site="h"/></spatial></tendon>
  <actuator><motor tendon="out" ctrlrange="-50 0"/><motor tendon="in" ctrlrange="-50 0"/>
    <motor tendon="left" ctrlrange="-50 0"/><motor tendon="right" ctrlrange="-50 0"/></actuator>
</mujoco>"""

URDF = """<robot name="own">
  <link name="base"><inertial><origin xyz="0 0.01 0.1"/><mass value="2"/>
    <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.01"/></inertial></link>
  <link name="arm"><inertial><origin xyz="0.01 0 -0.15" rpy="0.2 0 0"/><mass value="1"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.001"/></inertial></link>
  <link name="hand"><inertial><origin xyz="0 0 -0.05"/><mass value="0.4"/>
    <inertia ixx="0.001" ixy="0" ixz="0" iyy="0.001" iyz="0" izz="0.001"/></inertial></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="arm"/>
    <origin xyz="0 0 0.2" rpy="0.1 0 0.3"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="wrist" type="revolute"><parent link="arm"/><child link="hand"/>
    <origin xyz="0 0 -0.3"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/>{mimic}</joint>
</robot>
"""

# The same arm as URDF, but with links whose frames are at their centres of mass, and joints that
# are given in the frame of their child link.
SDF = """<sdf version="1.6"><model name="own">
  <link name="base"><pose>0 0 0 0 0 0</pose>
    <inertial><pose>0 0.01 0.1 0 0 0</pose><mass>2</mass><inertia><ixx>0.02</ixx>
      <iyy>0.02</iyy><izz>0.01</izz></inertia></inertial></link>
  <link name="arm"><pose>0 0 0.1 0 0 0</pose>
    <inertial><mass>1</mass><inertia><ixx>0.01</ixx><iyy>0.01</iyy><izz>0.001</izz></inertia>
    </inertial></link>
  <joint name="shoulder" type="revolute"><parent>base</parent><child>arm</child>
    <pose>0 0 0.1 0 0 0</pose>
    <axis><xyz>0 1 0</xyz><limit><lower>-1</lower><upper>1</upper></limit></axis></joint>
</model></sdf>
"""

CARDSFLOW = """<cardsflow>
  <myoMuscle name="front"><link name="base"><viaPoint type="FIXPOINT">0.05 0 0.1</viaPoint></link>
    <link name="arm"><viaPoint type="FIXPOINT">0.04 0 0.05</viaPoint></link></myoMuscle>
  <myoMuscle name="back"><link name="base"><viaPoint type="FIXPOINT">-0.05 0 0.1</viaPoint>
    <viaPoint type="SPHERICAL" radius="0.02" state="1" revCounter="0">0 -0.01 0.1</viaPoint></link>
    <link name="arm"><viaPoint type="FIXPOINT">-0.04 0 0.05</viaPoint></link></myoMuscle>
  <myoMuscle name="still"><link name="world"><viaPoint>0.05 0 0.1</viaPoint></link>
    <link name="base"><viaPoint>0 0 0</viaPoint></link></myoMuscle>
</cardsflow>
"""

#: a finger whose straight flexor passes over the axis of its joint, and with a return spring
SNAPPING = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <site name="f0" pos="0.01 0 0.02"/><site name="e0" pos="-0.01 0 0.02"/>
    <body name="finger">
      <joint name="mcp" axis="0 1 0" range="0 1.5" damping="0.01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.05" size="0.008" mass="0.03"/>
      <site name="f1" pos="0.01 0 -0.02"/><site name="e1" pos="-0.01 0 -0.02"/>
    </body>
  </worldbody>
  <tendon>
    <spatial name="flexor"><site site="f0"/><site site="f1"/></spatial>
    <spatial name="return" stiffness="500" springlength="0 0.01">
      <site site="e0"/><site site="e1"/>
    </spatial>
  </tendon>
  <actuator><motor name="flexor" tendon="flexor" ctrlrange="-60 0"/></actuator>
</mujoco>
"""

#: a finger of two joints that springs extend and one tendon flexes
UNDERACTUATED = """
<mujoco model="underactuated">
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <site name="f0" pos="0.009 0 0.009"/>
    <body name="proximal">
      <joint name="mcp" axis="0 -1 0" range="0 1.5" damping="0.01" stiffness="0.03"
        springref="-0.5"/>
      <geom type="capsule" fromto="0 0 -0.01 0 0 -0.035" size="0.007" mass="0.015"/>
      <site name="f1" pos="0.009 0 -0.009"/><site name="f2" pos="0.009 0 -0.036"/>
      <body name="distal" pos="0 0 -0.045">
        <joint name="pip" axis="0 -1 0" range="0 1.5" damping="0.01" stiffness="0.02"
          springref="-0.7"/>
        <geom type="capsule" fromto="0 0 -0.01 0 0 -0.03" size="0.006" mass="0.01"/>
        <site name="f3" pos="0.009 0 -0.009"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <spatial name="flexor">
      <site site="f0"/><site site="f1"/><site site="f2"/><site site="f3"/>
    </spatial>
  </tendon>
  <actuator><motor name="flexor" tendon="flexor" ctrlrange="-12 0"/></actuator>
</mujoco>
"""

#: a pendulum that is far too heavy for its two tendons
HEAVY = """
<mujoco model="heavy">
  <worldbody>
    <site name="a0" pos="0.03 0 0.1"/><site name="b0" pos="-0.03 0 0.1"/>
    <body name="link">
      <joint name="swing" axis="0 1 0" range="-60 60"/>
      <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.05" mass="500"/>
      <site name="a1" pos="0.03 0 -0.1"/><site name="b1" pos="-0.03 0 -0.1"/>
      <body name="tip" pos="0.5 0 0">
        <joint name="loose" axis="0 1 0" range="-60 60"/><geom size="0.02" mass="0.1"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <spatial name="a"><site site="a0"/><site site="a1"/></spatial>
    <spatial name="b"><site site="b0"/><site site="b1"/></spatial>
  </tendon>
  <actuator>
    <motor name="a" tendon="a" ctrlrange="-50 0"/><motor name="b" tendon="b" ctrlrange="-50 0"/>
  </actuator>
</mujoco>
"""
