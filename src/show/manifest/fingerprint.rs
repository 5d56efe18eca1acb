//! Fingerprint of a plan's input.

use std::{
    fs, io,
    path::{Path, PathBuf},
};

use crate::{
    base::{error::Hint, input},
    config::Settings,
    io::project::Project,
    model::scene::Scene,
};

/// The input cannot be read to compute its fingerprint.
#[derive(Debug, thiserror::Error)]
#[error("cannot read {}: {source}", path.display())]
pub struct FingerprintError {
    path: PathBuf,
    source: io::Error,
}

impl Hint for FingerprintError {
    fn hint(&self) -> Option<String> {
        Some("plan again, and do not change the model meanwhile".into())
    }
}

/// Computes the BLAKE3 hash, in hexadecimal, of the model's files, the mesh and the region that the settings name, and the name and size of each
/// registered image.
pub fn fingerprint(project: &Project, scene: &Scene, settings: &Settings) -> Result<String, FingerprintError> {
    let mut hasher = blake3::Hasher::new();
    for path in project.model_files().into_iter().chain(settings.files_of_plan()) {
        let failed = |source| FingerprintError { path: path.clone(), source };
        // Length prefixes keep different lists of files from giving the same bytes.
        let length = fs::metadata(&path).map_err(failed)?.len();
        hasher.update(&length.to_le_bytes());
        hasher.update_reader(input::open(&path).map_err(failed)?).map_err(failed)?;
    }
    for view in &scene.views {
        hasher.update(&(view.name.len() as u64).to_le_bytes()).update(view.name.as_bytes());
        let size = project.images.as_deref().and_then(|images| size(&images.join(&view.name)));
        hasher.update(&size.unwrap_or(u64::MAX).to_le_bytes());
    }
    Ok(hasher.finalize().to_string())
}

fn size(path: &Path) -> Option<u64> {
    fs::metadata(path).ok().map(|found| found.len())
}
