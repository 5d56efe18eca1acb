//! Reads from a written evaluation how far the depth maps of its plan have come.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::{base::input::FileKind, io::output};

/// Path of the evaluation, relative to the project.
pub const EVALUATION_FILE: &str = "viewrank/evaluation/evaluation.json";

/// The part of `evaluation.json` that viewrank reads back.
#[derive(Debug, Deserialize)]
pub struct WrittenEvaluation {
    /// Folder of the depth maps.
    pub depth_maps: PathBuf,
    reached: WrittenShare,
    key_views: Vec<WrittenKeyView>,
}

#[derive(Debug, Deserialize)]
struct WrittenShare {
    share: Option<f64>,
}

#[derive(Debug, Deserialize)]
struct WrittenKeyView {
    name: String,
}

impl WrittenEvaluation {
    /// Reads the evaluation of a project; `None` where there is none or it is unreadable.
    pub fn read(root: &Path) -> Option<Self> {
        let bytes = output::read_own(root, EVALUATION_FILE, FileKind::Record).ok()?;
        serde_json::from_slice(&bytes).ok()
    }

    /// Returns the share that the maps reach of the result expected of all, 0 to 1.
    pub fn share(&self) -> Option<f64> {
        let share = self.reached.share;
        share.map(|share| share.clamp(0.0, 1.0))
    }

    /// Returns the names of the measured key views.
    pub fn key_views(&self) -> impl Iterator<Item = &str> {
        self.key_views.iter().map(|view| view.name.as_str())
    }
}
