//! The compiled models, number for number: `environments/model_facts/*.json`.

use ksim_envs::mujoco::{self, MujocoEnvironment};
use ksim_envs::{EnvironmentError, EnvironmentSpec};
use mujoco_rs::wrappers::mj_model::{MjModel, MjtObjBase};
use serde_json::{Map, Value, json};

use crate::recording;

/// The names in an enumeration of MuJoCo, by number.
const INTEGRATORS: [&str; 2] = ["mjINT_EULER", "mjINT_RK4"];
const SOLVERS: [&str; 3] = ["mjSOL_PGS", "mjSOL_CG", "mjSOL_NEWTON"];
const CONES: [&str; 2] = ["mjCONE_PYRAMIDAL", "mjCONE_ELLIPTIC"];
const JOINTS: [&str; 4] = ["mjJNT_FREE", "mjJNT_BALL", "mjJNT_SLIDE", "mjJNT_HINGE"];
const GEOMS: [&str; 7] = [
    "mjGEOM_PLANE",
    "mjGEOM_HFIELD",
    "mjGEOM_SPHERE",
    "mjGEOM_CAPSULE",
    "mjGEOM_ELLIPSOID",
    "mjGEOM_CYLINDER",
    "mjGEOM_BOX",
];

fn name(model: &MjModel, kind: MjtObjBase, id: usize) -> Option<&str> {
    model.id_to_name(kind, id).filter(|name| !name.is_empty())
}

fn counts(model: &MjModel) -> Value {
    let ffi = model.ffi();
    json!({
        "nq": ffi.nq, "nv": ffi.nv, "nu": ffi.nu, "na": ffi.na, "nbody": ffi.nbody, "njnt": ffi.njnt,
        "ngeom": ffi.ngeom, "nsite": ffi.nsite, "ncam": ffi.ncam, "nlight": ffi.nlight,
    })
}

fn option(model: &MjModel) -> Value {
    let option = model.opt();
    json!({
        "timestep": option.timestep,
        "integrator": INTEGRATORS[option.integrator as usize],
        "solver": SOLVERS[option.solver as usize],
        "cone": CONES[option.cone as usize],
        "jacobian": option.jacobian,
        "iterations": option.iterations,
        "tolerance": option.tolerance,
        "ls_iterations": option.ls_iterations,
        "ls_tolerance": option.ls_tolerance,
        "noslip_iterations": option.noslip_iterations,
        "ccd_iterations": option.ccd_iterations,
        "gravity": option.gravity,
        "density": option.density,
        "viscosity": option.viscosity,
        "impratio": option.impratio,
        "disableflags": option.disableflags,
        "enableflags": option.enableflags,
    })
}

fn body(model: &MjModel, id: usize) -> Value {
    json!({
        "id": id,
        "name": name(model, MjtObjBase::mjOBJ_BODY, id),
        "parent": model.body_parentid()[id],
        "mass": model.body_mass()[id],
        "pos": model.body_pos()[id],
        "quat": model.body_quat()[id],
        "ipos": model.body_ipos()[id],
        "iquat": model.body_iquat()[id],
        "inertia": model.body_inertia()[id],
    })
}

fn joint(model: &MjModel, id: usize) -> Value {
    json!({
        "id": id,
        "name": name(model, MjtObjBase::mjOBJ_JOINT, id),
        "type": JOINTS[model.jnt_type()[id] as usize],
        "body": model.jnt_bodyid()[id],
        "qposadr": model.jnt_qposadr()[id],
        "dofadr": model.jnt_dofadr()[id],
        "axis": model.jnt_axis()[id],
        "pos": model.jnt_pos()[id],
        "limited": model.jnt_limited()[id],
        "range": model.jnt_range()[id],
        "stiffness": model.jnt_stiffness()[id],
        "margin": model.jnt_margin()[id],
        "solref": model.jnt_solref()[id],
        "solimp": model.jnt_solimp()[id],
    })
}

fn actuator(model: &MjModel, id: usize) -> Value {
    let joint = usize::try_from(model.actuator_trnid()[id][0]).unwrap();
    json!({
        "id": id,
        "joint": name(model, MjtObjBase::mjOBJ_JOINT, joint),
        "gear": model.actuator_gear()[id],
        "ctrllimited": model.actuator_ctrllimited()[id],
        "ctrlrange": model.actuator_ctrlrange()[id],
        "gainprm0": model.actuator_gainprm()[id][0],
    })
}

fn geom(model: &MjModel, id: usize) -> Value {
    json!({
        "id": id,
        "name": name(model, MjtObjBase::mjOBJ_GEOM, id),
        "type": GEOMS[model.geom_type()[id] as usize],
        "body": model.geom_bodyid()[id],
        "pos": model.geom_pos()[id],
        "quat": model.geom_quat()[id],
        "size": model.geom_size()[id],
        "contype": model.geom_contype()[id],
        "conaffinity": model.geom_conaffinity()[id],
        "condim": model.geom_condim()[id],
        "friction": model.geom_friction()[id],
        "solref": model.geom_solref()[id],
        "solimp": model.geom_solimp()[id],
        "margin": model.geom_margin()[id],
        "gap": model.geom_gap()[id],
    })
}

fn site(model: &MjModel, id: usize) -> Value {
    json!({
        "id": id,
        "name": name(model, MjtObjBase::mjOBJ_SITE, id),
        "pos": model.site_pos()[id],
        "size": model.site_size()[id],
    })
}

fn model_facts(model: &MjModel) -> Value {
    let all = |n: usize, one: fn(&MjModel, usize) -> Value| {
        (0..n).map(|id| one(model, id)).collect::<Vec<_>>()
    };
    json!({
        "counts": counts(model),
        "option": option(model),
        "qpos0": model.qpos0(),
        "bodies": all(model.body_mass().len(), body),
        "joints": all(model.jnt_type().len(), joint),
        "dofs": {
            "damping": model.dof_damping(),
            "armature": model.dof_armature(),
            "frictionloss": model.dof_frictionloss(),
        },
        "actuators": all(model.actuator_gear().len(), actuator),
        "geoms": all(model.geom_type().len(), geom),
        "sites": all(model.site_pos().len(), site),
    })
}

/// Compares all of `expected`, and names the place of what differs.
fn compare(place: &str, found: &Value, expected: &Value) {
    match (found, expected) {
        (Value::Object(found), Value::Object(expected)) => {
            assert_eq!(found.len(), expected.len(), "{place}");
            for (key, expected) in expected {
                compare(&format!("{place}.{key}"), &found[key], expected);
            }
        }
        (Value::Array(found), Value::Array(expected)) => {
            assert_eq!(found.len(), expected.len(), "{place}");
            for (index, (found, expected)) in found.iter().zip(expected).enumerate() {
                compare(&format!("{place}[{index}]"), found, expected);
            }
        }
        _ => assert_eq!(found, expected, "{place}"),
    }
}

/// Numbers in the parts of an observation, by name, or as a shape where there is only one part.
fn shapes(spec: &EnvironmentSpec) -> (&'static str, Value) {
    match &spec.observation[..] {
        [only] => ("observation_shape", json!([only.width])),
        parts => {
            let by_name: Map<String, Value> = parts
                .iter()
                .map(|part| (part.name.to_owned(), json!([part.width])))
                .collect();
            ("observation_shapes", Value::Object(by_name))
        }
    }
}

fn check(facts: &Value, environment: &dyn MujocoEnvironment) {
    let id = facts["env_id"].as_str().unwrap();
    let model = environment.physics().model();
    let mut expected = facts["model"].clone();
    // The masses are compared one by one; their sum depends on the order of adding.
    let total_mass = expected.as_object_mut().unwrap().remove("total_mass");
    let difference = model.totalmass() - total_mass.unwrap().as_f64().unwrap();
    assert!(difference.abs() <= 1e-14, "{id}.total_mass: {difference:e}");
    compare(id, &model_facts(model), &expected);
    let spec = environment.spec();
    assert_eq!(spec.max_episode_steps, facts["max_episode_steps"], "{id}");
    assert_eq!(spec.dt_s, facts["dt"], "{id}");
    assert_eq!(json!(spec.action_low), facts["action_low"], "{id}");
    assert_eq!(json!(spec.action_high), facts["action_high"], "{id}");
    let (key, found) = shapes(spec);
    compare(&format!("{id}.{key}"), &found, &facts[key]);
}

#[test]
fn golden_model_facts_of_every_environment() {
    let mut n_known = 0;
    for path in recording::files("model_facts", "json") {
        let facts: Value = serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap();
        match mujoco::make(facts["env_id"].as_str().unwrap(), &Map::new(), None) {
            Err(EnvironmentError::UnknownId { .. }) => {}
            made => {
                check(&facts, made.unwrap().as_ref());
                n_known += 1;
            }
        }
    }
    assert!(
        n_known > 0,
        "no model facts in {}",
        recording::folder().display()
    );
}
