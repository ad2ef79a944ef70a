//! HalfCheetah: a planar runner of eight capsules, 14 kg.

use super::{CAMERA, ground, motor, numbers};

/// A capsule of radius 0.046 m, turned about y.
struct Capsule {
    name: &'static str,
    /// Center, as x and z in m.
    center: [f64; 2],
    /// Angle about y, in rad.
    angle: f64,
    /// Half the length of the cylinder, in m.
    half_length: f64,
    is_light: bool,
}

impl Capsule {
    fn xml(&self) -> String {
        let [x, z] = self.center;
        let color = if self.is_light {
            r#" rgba="0.9 0.6 0.6 1""#
        } else {
            ""
        };
        format!(
            r#"<geom name="{}" type="capsule" pos="{x} 0 {z}" axisangle="0 1 0 {}" size="0.046 {}"{color}/>"#,
            self.name, self.angle, self.half_length
        )
    }
}

/// A link of a leg: a body with one hinge about y, one capsule and one motor of the same name.
struct Link {
    /// Where it hangs in its parent, as x and z in m.
    at: [f64; 2],
    capsule: Capsule,
    /// Limits, in rad.
    range: [f64; 2],
    /// Spring [Nm/rad] and damping [Nms/rad] of the hinge.
    stiffness: f64,
    damping: f64,
    gear: f64,
    /// Mass [kg] and moments of inertia [kg m²] about the capsule's own axes.
    mass: f64,
    inertia: [f64; 2],
}

impl Link {
    fn xml(&self, below: &str) -> String {
        let Self {
            at: [x, z],
            capsule,
            ..
        } = self;
        let name = capsule.name;
        let [across, along] = self.inertia;
        let [center_x, center_z] = capsule.center;
        format!(
            r#"
            <body name="{name}" pos="{x} 0 {z}">
                <inertial pos="{center_x} 0 {center_z}" axisangle="0 1 0 {}" mass="{}" diaginertia="{}"/>
                <joint name="{name}" type="hinge" axis="0 1 0" range="{}" stiffness="{}" damping="{}"/>
                {}{below}
            </body>"#,
            capsule.angle,
            self.mass,
            numbers([across, across, along]),
            numbers(self.range),
            self.stiffness,
            self.damping,
            capsule.xml(),
        )
    }

    fn motor(&self) -> String {
        motor(Some(self.capsule.name), self.capsule.name, self.gear)
    }
}

/// Back leg, from the hip down.
const BACK: [Link; 3] = [
    Link {
        at: [-0.5, 0.0],
        capsule: Capsule {
            name: "bthigh",
            center: [0.1, -0.13],
            angle: -3.8,
            half_length: 0.145,
            is_light: false,
        },
        range: [-0.52, 1.05],
        stiffness: 240.0,
        damping: 6.0,
        gear: 120.0,
        mass: 1.5435146443514645,
        inertia: [0.01684433958158996, 0.0015760215899581589],
    },
    Link {
        at: [0.16, -0.25],
        capsule: Capsule {
            name: "bshin",
            center: [-0.14, -0.07],
            angle: -2.03,
            half_length: 0.15,
            is_light: true,
        },
        range: [-0.785, 0.785],
        stiffness: 180.0,
        damping: 4.5,
        gear: 90.0,
        mass: 1.5874476987447697,
        inertia: [0.018267419079497905, 0.0016225027615062756],
    },
    Link {
        at: [-0.28, -0.14],
        capsule: Capsule {
            name: "bfoot",
            center: [0.03, -0.097],
            angle: -0.27,
            half_length: 0.094,
            is_light: true,
        },
        range: [-0.4, 0.785],
        stiffness: 120.0,
        damping: 3.0,
        gear: 60.0,
        mass: 1.0953974895397491,
        inertia: [0.0063524232635983275, 0.0011019136401673642],
    },
];

/// Front leg, from the shoulder down.
const FRONT: [Link; 3] = [
    Link {
        at: [0.5, 0.0],
        capsule: Capsule {
            name: "fthigh",
            center: [-0.07, -0.12],
            angle: 0.52,
            half_length: 0.133,
            is_light: false,
        },
        range: [-1.0, 0.7],
        stiffness: 180.0,
        damping: 4.5,
        gear: 120.0,
        mass: 1.4380753138075317,
        inertia: [0.013739643347280341, 0.0014644667782426782],
    },
    Link {
        at: [-0.14, -0.24],
        capsule: Capsule {
            name: "fshin",
            center: [0.065, -0.09],
            angle: -0.6,
            half_length: 0.106,
            is_light: true,
        },
        range: [-1.2, 0.87],
        stiffness: 120.0,
        damping: 3.0,
        gear: 60.0,
        mass: 1.200836820083682,
        inertia: [0.008222108619246861, 0.001213468451882845],
    },
    Link {
        at: [0.13, -0.18],
        capsule: Capsule {
            name: "ffoot",
            center: [0.045, -0.07],
            angle: -0.6,
            half_length: 0.07,
            is_light: true,
        },
        range: [-0.5, 0.5],
        stiffness: 60.0,
        damping: 1.5,
        gear: 30.0,
        mass: 0.8845188284518829,
        inertia: [0.003529109456066946, 0.0008788040167364017],
    },
];

const HEAD: Capsule = Capsule {
    name: "head",
    center: [0.6, 0.1],
    angle: 0.87,
    half_length: 0.15,
    is_light: false,
};

/// Mass and inertia of torso and head together. The published masses are those of a density, scaled to 14 kg in all.
const TORSO_INERTIAL: &str = r#"<inertial pos="0.15238987816307403 0 0.025398313027179008"
                quat="0.5224297915933479 0.4765155956059912 0.4765155956059912 0.5224297915933479"
                mass="6.25020920502092" diaginertia="0.8971176881117434 0.8856554522351578 0.01796092340796636"/>"#;

/// The model.
pub(crate) fn xml() -> String {
    let leg = |links: &[Link; 3]| {
        links
            .iter()
            .rev()
            .fold(String::new(), |below, link| link.xml(&below))
    };
    let (back, front) = (leg(&BACK), leg(&FRONT));
    let motors: String = BACK.iter().chain(&FRONT).map(Link::motor).collect();
    let head = HEAD.xml();
    let ground = ground([40.0; 3], "");
    format!(
        r#"<mujoco model="half_cheetah">
    <compiler angle="radian"/>
    <option timestep="0.01" integrator="Euler"/>
    <default>
        <joint armature="0.1" limited="true" solimplimit="0 0.8 0.03"/>
        <geom contype="1" conaffinity="0" condim="3" friction="0.4 0.1 0.1" solimp="0 0.8 0.01"
            rgba="0.8 0.6 0.4 1"/>
    </default>
    <worldbody>
        {ground}
        <body name="torso" pos="0 0 0.7">
            {CAMERA}
            {TORSO_INERTIAL}
            <joint name="rootx" type="slide" axis="1 0 0" armature="0" limited="false"/>
            <joint name="rootz" type="slide" axis="0 0 1" armature="0" limited="false"/>
            <joint name="rooty" type="hinge" axis="0 1 0" armature="0" limited="false"/>
            <geom name="torso" type="capsule" fromto="-0.5 0 0 0.5 0 0" size="0.046"/>
            {head}{back}{front}
        </body>
    </worldbody>
    <actuator>{motors}</actuator>
</mujoco>
"#
    )
}
