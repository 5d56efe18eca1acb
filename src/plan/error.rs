//! The errors of planning.

use std::path::Path;

use super::{MeshError, RegionFileError, memory};
use crate::{
    base::{
        column::{DiskError, TableError},
        decimals::significant,
        error::{Advice, Hint},
        progress::Cancelled,
    },
    config::UnknownBackend,
    decision::DecisionError,
    io::{depthmaps::DepthMapError, project::ProjectError},
    method::{region::RegionError, surface::SurfaceError, visibility::VisibilityError},
    model::scene::ModelWarning,
};

/// Planning failed.
#[derive(Debug, thiserror::Error)]
pub enum PlanError {
    #[error(transparent)]
    Project(#[from] ProjectError),
    /// `why`: what the reader of the model said, and what to do.
    #[error("{}: the model has no registered image{}", model.display(), because(why))]
    NoViews {
        model: std::path::PathBuf,
        why: Vec<ModelWarning>,
    },
    #[error("{}: no image of the model is in this folder, e.g. no {name}", folder.display())]
    OtherImages {
        folder: std::path::PathBuf,
        name: String,
    },
    #[error("most images have {} times the size of their cameras or less, and are to be matched at {} times", significant(*images), significant(*image_scale))]
    SmallImages { images: f64, image_scale: f64 },
    /// `fits`: the largest image_scale at which it is planned for.
    #[error("the camera of {name} has {} x {} pixels, more than are planned for without its image", size[0], size[1])]
    LargeCamera {
        name: String,
        size: [u32; 2],
        fits: f64,
    },
    #[error("{}: {what}", model.display())]
    NoObservations {
        model: std::path::PathBuf,
        what: String,
        cure: Option<Advice>,
    },
    #[error(
        "cannot derive the ground sampling distance: no view observes a sparse point in front of it"
    )]
    NoScale,
    #[error(transparent)]
    Surface(#[from] SurfaceError),
    #[error(transparent)]
    Visibility(VisibilityError),
    #[error(transparent)]
    Mesh(#[from] MeshError),
    #[error(transparent)]
    RegionFile(#[from] RegionFileError),
    #[error(transparent)]
    Region(RegionError),
    #[error(transparent)]
    Backend(#[from] UnknownBackend),
    #[error(transparent)]
    Decision(DecisionError),
    #[error(
        "the {stage} needs about {} of memory, but max_memory is {}",
        memory::readable(*need),
        memory::readable_limit(*limit)
    )]
    Memory {
        stage: &'static str,
        need: u64,
        limit: u64,
        with_pictures: u64,
    },
    #[error(
        "the {stage} needs about {} of memory, but a plan may take {} here",
        memory::readable(*need),
        memory::readable_limit(*most)
    )]
    Refused {
        stage: &'static str,
        need: u64,
        most: u64,
        with_pictures: u64,
    },
    /// The folder of `pilot.maps`.
    #[error("the pilot: {0}")]
    PilotMaps(#[from] DepthMapError),
    /// A link in the folder of `pilot.maps`.
    #[error("the pilot: the link {} leads out of the project", _0.display())]
    PilotLink(std::path::PathBuf),
    #[error(transparent)]
    Disk(#[from] DiskError),
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
}

impl PlanError {
    /// The error without anything from a file that it may not quote.
    pub(super) fn quoting(self, may_quote: impl Fn(&Path) -> bool) -> Self {
        match self {
            Self::Mesh(error) => error.quoting(may_quote).into(),
            Self::RegionFile(error) => error.quoting(may_quote).into(),
            error => error,
        }
    }
}

impl From<RegionError> for PlanError {
    fn from(error: RegionError) -> Self {
        match error {
            RegionError::Cancelled(cancelled) => Self::Cancelled(cancelled),
            error => Self::Region(error),
        }
    }
}

impl From<DecisionError> for PlanError {
    fn from(error: DecisionError) -> Self {
        match error {
            DecisionError::Table(error) => error.into(),
            error => Self::Decision(error),
        }
    }
}

impl From<VisibilityError> for PlanError {
    fn from(error: VisibilityError) -> Self {
        match error {
            VisibilityError::Table(error) => error.into(),
            error => Self::Visibility(error),
        }
    }
}

impl From<TableError> for PlanError {
    fn from(error: TableError) -> Self {
        match error {
            TableError::Cancelled(error) => Self::Cancelled(error),
            TableError::Disk(error) => Self::Disk(error),
        }
    }
}

/// Returns the reader's warnings, to follow the text of an error.
fn because(why: &[ModelWarning]) -> String {
    why.iter().map(|why| format!("; {}", why.text)).collect()
}

impl Hint for PlanError {
    fn hint(&self) -> Option<Advice> {
        Some(match self {
            Self::Project(error) => return error.hint(),
            Self::NoViews { why, .. } if why.iter().any(|why| why.cure.is_some()) => {
                let cures = why.iter().filter_map(|why| why.cure.clone());
                cures
                    .reduce(|all, cure| all.and("; ").join(cure))
                    .unwrap_or_default()
            }
            Self::NoViews { .. } => {
                Advice::text("run structure from motion first, or choose another model with ")
                    .set("model")
            }
            Self::OtherImages { name, .. } => {
                Advice::text(format!("name the folder in which {name} is, by "))
                    .set("images")
                    .and(" or in viewrank.toml")
            }
            Self::SmallImages { images, .. } => format!(
                "name the folder of the images that the model was made from, or set image_scale = {} in viewrank.toml",
                significant(*images)
            )
            .into(),
            // Less than fits, since the three digits that are shown may be rounded up.
            Self::LargeCamera { fits, .. } => format!(
                "give the images, look for a wrong camera, or set image_scale = {} in viewrank.toml",
                significant(0.99 * fits)
            )
            .into(),
            Self::NoObservations { cure, .. } => match cure {
                Some(cure) => cure.clone(),
                None => "export the model again, with its sparse points and their tracks".into(),
            },
            Self::NoScale => Advice::text("look for wrong poses: ").run("doctor"),
            Self::Surface(error) => return error.hint(),
            Self::Visibility(error) => return error.hint(),
            Self::Mesh(error) => return error.hint(),
            Self::RegionFile(error) => return error.hint(),
            Self::Region(error) => return error.hint(),
            Self::Backend(error) => return error.hint(),
            Self::Decision(error) => return error.hint(),
            Self::PilotMaps(_) => {
                Advice::text("give the folder of finished small maps (viewrank pilot makes their list): ")
                    .set("pilot.maps")
            }
            Self::PilotLink(_) => {
                Advice::text("copy the maps there, or name the folder where they are: ")
                    .set("pilot.maps")
            }
            Self::Memory {
                stage,
                with_pictures,
                ..
            } => more_memory(stage, *with_pictures),
            Self::Refused { with_pictures, .. } => more_memory_to_watch(*with_pictures),
            Self::Disk(error) => return error.hint(),
            Self::Cancelled(_) => return None,
        })
    }

    fn is_usage(&self) -> bool {
        match self {
            Self::OtherImages { .. } => true,
            Self::Decision(error) => error.is_usage(),
            Self::Project(error) => error.is_usage(),
            Self::Backend(error) => error.is_usage(),
            _ => false,
        }
    }

    fn path(&self) -> Option<&Path> {
        match self {
            Self::Project(error) => error.path(),
            Self::NoViews { model: path, .. }
            | Self::NoObservations { model: path, .. }
            | Self::OtherImages { folder: path, .. } => Some(path),
            Self::Surface(error) => error.path(),
            Self::Region(error) => error.path(),
            Self::Disk(error) => error.path(),
            _ => None,
        }
    }
}

/// Returns advice for a plan of the daemon that would exceed its memory limit.
fn more_memory_to_watch(with_pictures: u64) -> Advice {
    Advice::text("give ")
        .run("watch ")
        .set_to("max_memory", memory::enough(with_pictures))
        .and(
            " or more; less may do with max_memory in the project's viewrank.toml: a larger surface is then built in \
             tiles, larger tables are kept on disk, and fewer pictures and masks are read at once",
        )
}

/// Returns advice for a stage that exceeds the memory limit.
fn more_memory(stage: &str, need: u64) -> Advice {
    match stage {
        memory::SURFACE => allow(need).and(
            " or more (max_memory in viewrank.toml); what the tables need is forecast once the surface is built",
        ),
        memory::PICTURES | memory::PILOT => allow(need)
            .and(" (max_memory in viewrank.toml), or plan without pictures: ")
            .set_to("confidence.source", "geometric"),
        memory::MASKS => allow(need).and(
            " (max_memory in viewrank.toml), or make the masks smaller: copies of the same shape will do",
        ),
        _ => {
            let allow = allow(need).and(" (max_memory in viewrank.toml),");
            let allow = match rayon::current_num_threads() {
                0 | 1 => allow,
                _ => allow.and(" use fewer ").set("threads").and(","),
            };
            allow
                .and(" or reduce the triangles with a coarser ")
                .set("target.gsd")
                .and(" or a larger surface.edge_factor")
        }
    }
}

/// Begins advice to allow as much memory as is needed.
fn allow(need: u64) -> Advice {
    Advice::text("give ").set_to("max_memory", memory::enough(need))
}
