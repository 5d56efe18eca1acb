//! Phases of a project as they are shown, and the status file that `viewrank status` reads.

use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::{
    backends,
    base::{bounded, error::shortened},
    show::share::area_of_all,
};

/// State of a project as it is shown.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "state", rename_all = "lowercase")]
pub enum Phase {
    /// The input is incomplete or still changing.
    Waiting {
        /// The awaited condition.
        reason: String,
    },
    /// Complete; waits for a job slot or for memory.
    Queued {
        /// The awaited condition.
        reason: String,
    },
    /// A plan is being made.
    Planning {
        /// Stage of planning, as in `timings.json`.
        stage: String,
        /// Progress of the stage, 0 to 100.
        percent: u8,
    },
    /// Planned; no depth maps yet.
    Planned {
        /// The program that the plan is for, as `--backend` names it.
        #[serde(default)]
        backend: String,
        /// Number of key views up to the cut.
        clusters: usize,
        /// Predicted share of the area of the cloud of all view clusters that they give, 0 to 1.
        share: f64,
        /// True if only what is inside a region counts.
        #[serde(default, skip_serializing_if = "is_false")]
        has_region: bool,
        /// True if there is no export for a backend that the settings name.
        #[serde(default, skip_serializing_if = "is_false")]
        lacks_export: bool,
        /// Remark about the result.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        note: Option<String>,
    },
    /// Some depth maps are finished; the backend may be at work on others.
    Partial {
        /// The program that the plan is for, as `--backend` names it.
        #[serde(default)]
        backend: String,
        /// Number of key views with a depth map.
        done: usize,
        /// Number of key views up to the cut, plus those beyond it with a depth map.
        clusters: usize,
        /// Share of the area of the cloud of all view clusters that they give, 0 to 1: measured of
        /// them over what is expected of all, so an estimate; null where depth maps are counted, not
        /// measured.
        share: Option<f64>,
        /// Number of depth map files that are new or changed since the last measurement; left out
        /// where it is 0.
        #[serde(default, skip_serializing_if = "is_zero")]
        unmeasured: usize,
        /// True if only what is inside a region counts.
        #[serde(default, skip_serializing_if = "is_false")]
        has_region: bool,
        /// Remark about the result.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        note: Option<String>,
    },
    /// The target is reached, as far as finished maps tell; or the list is done, where only other
    /// limits are set.
    Reached {
        /// The program that the plan is for, as `--backend` names it.
        #[serde(default)]
        backend: String,
        /// Number of key views with a depth map.
        done: usize,
        /// Number of key views up to the cut, plus those beyond it with a depth map.
        clusters: usize,
        /// Share of the result of all view clusters that they give, 0 to 1, estimated as in
        /// `partial`.
        share: f64,
        /// True if only what is inside a region counts.
        #[serde(default, skip_serializing_if = "is_false")]
        has_region: bool,
        /// Remark about the result.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        note: Option<String>,
    },
    /// Planning or measuring failed; retried after a pause, or as soon as the input changes.
    Failed {
        /// The error and its location.
        reason: String,
        /// Suggested remedy.
        hint: Option<String>,
        /// Seconds from the failure to the next try.
        retry_after_s: u64,
    },
}

impl Phase {
    /// The same phase without the middle of long texts: the status has those of all projects, and
    /// is read up to a limit.
    pub fn shortened(mut self) -> Self {
        let texts: Vec<&mut String> = match &mut self {
            Self::Waiting { reason } | Self::Queued { reason } => vec![reason],
            Self::Planning { .. } => Vec::new(),
            Self::Planned { note, .. }
            | Self::Partial { note, .. }
            | Self::Reached { note, .. } => note.iter_mut().collect(),
            Self::Failed { reason, hint, .. } => [reason].into_iter().chain(hint).collect(),
        };
        for text in texts {
            *text = shortened(text).into_owned();
        }
        self
    }
}

impl Phase {
    fn note(&self) -> Option<&String> {
        match self {
            Self::Planned { note, .. }
            | Self::Partial { note, .. }
            | Self::Reached { note, .. } => note.as_ref(),
            _ => None,
        }
    }

    /// The same phase of a plan for this backend, where it is of a plan.
    pub fn of_plan_for(mut self, name: &str) -> Self {
        if let Self::Planned { backend, .. }
        | Self::Partial { backend, .. }
        | Self::Reached { backend, .. } = &mut self
        {
            *backend = name.into();
        }
        self
    }
}

fn is_false(flag: &bool) -> bool {
    !flag
}

fn is_zero(n: &usize) -> bool {
    *n == 0
}

impl fmt::Display for Phase {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let area = |has_region: &bool| area_of_all(None, *has_region);
        match self {
            Self::Waiting { reason } => write!(f, "waiting: {reason}"),
            Self::Queued { reason } => write!(f, "queued: {reason}"),
            Self::Planning { stage, percent } => write!(f, "planning: {stage} {percent} %"),
            Self::Planned {
                backend,
                clusters,
                share,
                has_region,
                ..
            } => {
                let (of, chosen) = (of(backend), chosen_for(backend, *clusters));
                let forecast = forecast(backend, *share, *has_region);
                write!(f, "planned{of}: {chosen}{forecast}")
            }
            Self::Partial {
                backend,
                done,
                clusters,
                share,
                unmeasured,
                has_region,
                ..
            } => {
                write!(f, "partial{}: {done} of {clusters} depth maps", of(backend))?;
                // Rounded down: 89.9 % must not look like a reached target of 90 %.
                share.iter().try_for_each(|share| {
                    let percent = (share * 100.0).floor();
                    write!(f, ", about {percent:.0} % of {}", area(has_region))
                })?;
                match *unmeasured {
                    0 => Ok(()),
                    1 => write!(f, ", 1 new file to measure"),
                    n => write!(f, ", {n} new files to measure"),
                }
            }
            Self::Reached {
                backend,
                done,
                share,
                has_region,
                ..
            } => {
                let (of, percent, area) = (of(backend), share * 100.0, area(has_region));
                write!(
                    f,
                    "done{of}: {done} depth maps, about {percent:.0} % of {area}"
                )
            }
            Self::Failed {
                reason,
                retry_after_s: wait,
                ..
            } => write!(f, "failed: {reason} (retry {wait} s after the failure)"),
        }?;
        let mut note = self.note().into_iter();
        note.try_for_each(|note| write!(f, "; {note}"))
    }
}

/// Returns what the chosen depth maps are expected to give, in words; empty for images.
fn forecast(backend: &str, share: f64, has_region: bool) -> String {
    if !makes_maps(backend) {
        return String::new();
    }
    let (percent, area) = (share * 100.0, area_of_all(None, has_region));
    format!(" for {percent:.0} % of {area}")
}

/// Returns what a plan chooses for a backend, in words.
pub(super) fn chosen_for(backend: &str, number: usize) -> String {
    let one = if makes_maps(backend) {
        "depth map"
    } else {
        "image"
    };
    let ending = if number == 1 { "" } else { "s" };
    format!("{number} {one}{ending}")
}

/// Names the backend, if it is known.
fn of(backend: &str) -> String {
    if backend.is_empty() {
        String::new()
    } else {
        format!(" for {backend}")
    }
}

/// Returns false for backends that use the images themselves.
fn makes_maps(backend: &str) -> bool {
    backends::by_name(backend).map_or(true, |backend| backend.makes_maps())
}

/// Version of the format of [`Status`].
pub const STATUS_VERSION: u32 = 1;

/// `ROOT/viewrank/status.json`: all projects of a root, for `viewrank status`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Status {
    /// Version of this format.
    pub version: u32,
    /// Process ID of the daemon that wrote the file.
    pub pid: u32,
    /// Host name of that process.
    pub host: String,
    /// Notices about the whole root: lost events, unreadable folders.
    #[serde(deserialize_with = "bounded::list::<_, _, 1000>")]
    pub notices: Vec<String>,
    /// All projects, sorted by path.
    #[serde(deserialize_with = "bounded::list::<_, _, 100_000>")]
    pub projects: Vec<ProjectStatus>,
}

/// Status of one project.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ProjectStatus {
    /// Path relative to the root, with `/` between folders; "." for the root itself.
    pub project: String,
    #[serde(flatten)]
    pub phase: Phase,
    /// Start of the phase, in seconds since 1970.
    pub since: u64,
    /// True while its depth maps are measured.
    #[serde(default, skip_serializing_if = "is_false")]
    pub measuring: bool,
}
