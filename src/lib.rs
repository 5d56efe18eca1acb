//! Ranks multi-view stereo view clusters before any depth map is computed: which views should get
//! one, against which others each should be matched, and in which order.
//!
//! ```
//! use viewrank::{Project, Settings, NoWatcher};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/fixtures/valley");
//! let project = Project::open(folder.as_ref(), None)?;
//! let plan = viewrank::plan(&project, &Settings::default(), &NoWatcher)?;
//! let keys: Vec<&str> = plan.chosen().map(|cluster| plan.stages.scene.name(cluster.key)).collect();
//! # assert!(!keys.is_empty());
//! # Ok(())
//! # }
//! ```
//!
//! # Where to start
//!
//! - [`Project::open`] finds the sparse model (COLMAP, OpenMVS, AliceVision, OpenSfM, ...) and the
//!   images of a folder.
//! - [`plan`] computes a [`Plan`]: the result of each stage ([`Stages`]) and the ranking with its
//!   cut ([`Decision`]).
//! - [`files::files`] turns a plan into the files of a project, and [`output::write_all`] writes
//!   them, all or none.
//! - [`manifest::WrittenPlan`] reads a written plan, and [`evaluate`] compares it with finished
//!   depth maps.
//! - [`backends`] lists the MVS programs and writes their input files.
//! - [`Scene::from_arrays`] and [`Project::create`] turn a model in memory into a project.
//!
//! `examples/` has a short program for each: `quickstart.rs`, `plan.rs`, `inspect.rs` and
//! `evaluate.rs`; `python/` has the Python module.
//!
//! # Conventions
//!
//! Poses map world to camera (`cam_from_world`: x right, y down, z forward). Lengths are in scene
//! units, pixels have their centres at 0.5. The same input gives the same result with any number of
//! threads. The library never prints and never exits; every error implements [`Hint`], which says
//! what to do about it. A [`Watcher`] receives progress and can cancel a run.
//!
//! `docs/method.md` has the mathematics, `ARCHITECTURE.md` the structure of the source.

#![deny(clippy::print_stdout, clippy::print_stderr)]

mod apps;
pub mod backends;
mod base;
#[cfg(feature = "cli")]
pub mod cli;
pub mod config;
pub mod daemon;
mod plan;
mod show;

use viewrank_core::{decision, method, model};
use viewrank_io as io;

pub use apps::planning::{plan, plan_scene};
pub use apps::{doctor, evaluate, learn, replan, report};
pub use base::{
    error::{Advice, Hint},
    progress::{Cancelled, NoWatcher, Stage, Watcher},
};
pub use config::Settings;
pub use io::{
    output,
    project::{CreateError, Project, ProjectError},
};
pub use method::{
    fulfilment::FulfilmentTable,
    partners::Candidates,
    ranking::{Maps, Objective, Ranking},
    target::Target,
    visibility::Visibility,
};
pub use model::{
    arrays::{ArraysError, Intrinsics, SceneArrays},
    camera::Camera,
    cluster::{MapScale, RankedCluster, ViewCluster},
    reason::Reason,
    scene::{PointIndex, Pose, Scene, View, ViewIndex},
    surface::Surface,
};
pub use plan::{
    CurvePoint, Cut, Decision, FinishedMaps, Forecast, Matcher, Plan, PlanError, PlanningNumbers,
    Stages, Timings, ViewStatus, WorkPerMap, metres_per_unit,
};
pub use show::{files, manifest, pictures, tables};
