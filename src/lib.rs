//! Ranks multi-view stereo view clusters before any depth map is computed: which views should get one, against which others each should be
//! matched, and in which order.
//!
//! ```
//! use viewrank::{Project, Settings, Unwatched};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/fixtures/valley");
//! let project = Project::open(folder.as_ref(), None)?;
//! let plan = viewrank::plan(&project, &Settings::default(), &Unwatched)?;
//! let keys: Vec<&str> = plan.chosen().map(|cluster| plan.stages.scene.name(cluster.key)).collect();
//! # assert!(!keys.is_empty());
//! # Ok(())
//! # }
//! ```
//!
//! [`plan`] gives a [`Plan`]: the value of each stage of the method ([`Stages`]) and what was decided on them ([`Decision`]).
//! [`show::files()`] turns it into the files of a project, [`manifest`] reads them again, and [`backends`] knows the programs that match.
//!
//! The source is built in floors, each of which knows only those before it: `base`, `model`, `io`, `config`, `method`, `plan`, `backends`, `show`,
//! `apps`, `daemon`, `cli`. `ARCHITECTURE.md` has the picture, `docs/method.md` the mathematics.

mod apps;
pub mod backends;
mod base;
#[cfg(feature = "cli")]
pub mod cli;
pub mod config;
mod daemon;
mod io;
mod method;
mod model;
mod plan;
mod show;

pub use apps::{doctor, evaluate, learn, replan, report};
pub use backends::plan;
pub use base::{
    error::Hint,
    progress::{Cancelled, Stage, Unwatched, Watcher},
};
pub use config::Settings;
pub use io::{
    output,
    project::{Project, ProjectError},
};
pub use method::{
    fulfilment::FulfilmentTable, partners::Candidates, ranking::Ranking, surface::Surface, target::Target,
    visibility::Visibility,
};
pub use model::{
    camera::Camera,
    cluster::{RankedCluster, ViewCluster},
    reason::Reason,
    scene::{PointIndex, Pose, Scene, View, ViewIndex},
};
pub use plan::{
    Cut, Decision, Finished, Forecast, Matcher, Plan, PlanError, PlanningNumbers, Stages, Timings, ViewStatus,
};
pub use show::{files, manifest};

/// Every floor's modules, for the tests, benchmarks and fuzz targets of this repository; no part of the interface.
#[cfg(feature = "internals")]
#[doc(hidden)]
pub mod internals {
    pub use crate::{apps::*, backends, base::*, config, io::*, method::*, model::*, show::*};

    pub mod daemon {
        pub use crate::daemon::*;
    }

    pub mod plan {
        pub use crate::plan::*;
    }
}
