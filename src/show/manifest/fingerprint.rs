//! Fingerprint of a plan's input.

use std::{
    fs,
    io::{self, Read, Seek, SeekFrom},
    path::{Path, PathBuf},
};

use rayon::prelude::*;

use crate::{
    base::{
        error::{Advice, Hint},
        input,
        paths::is_outside,
    },
    config::{ConfidenceSource, Settings},
    io::{depthmaps, pictures::PictureFolders, project::Project},
    model::scene::{Scene, View},
};

/// Bytes at either end of a picture that the fingerprint covers: headers and, in a compressed
/// picture, what any change to it shifts. Reading all of ten thousand images would take minutes
/// before each export.
const END: u64 = 1 << 16;

/// The input cannot be read to compute its fingerprint.
#[derive(Debug, thiserror::Error)]
#[error("cannot read {}: {source}", path.display())]
pub struct FingerprintError {
    path: PathBuf,
    source: io::Error,
}

impl Hint for FingerprintError {
    fn hint(&self) -> Option<Advice> {
        Some("plan again, and do not change the model meanwhile".into())
    }
}

/// Computes the BLAKE3 hash, in hexadecimal, of the model's files, the mesh and the region that the
/// settings name, the name and size of each registered image and, where the confidence source in
/// force reads them, the first and last 64 KiB of images and masks; also of the pilot's maps, if
/// these are outside: a plan that a stranger wrote has them read only if they are known.
pub fn fingerprint(
    project: &Project,
    scene: &Scene,
    settings: &Settings,
) -> Result<String, FingerprintError> {
    let mut hasher = blake3::Hasher::new();
    for path in project
        .model_files()
        .into_iter()
        .chain(settings.files_of_plan())
    {
        let failed = |source| FingerprintError {
            path: path.clone(),
            source,
        };
        // Length prefixes keep different lists of files from giving the same bytes.
        let length = fs::metadata(&path).map_err(failed)?.len();
        hasher.update(&length.to_le_bytes());
        hasher
            // As long as it was when its length was hashed, even if it grows.
            .update_reader(input::open(&path).map_err(failed)?.take(length))
            .map_err(failed)?;
    }
    for map in maps_outside(project, scene, settings) {
        // Always as many bytes, also without a hash, so that nothing after them moves up.
        let hash = ends(&map).map_or([0; blake3::OUT_LEN], |hash| *hash.as_bytes());
        hasher.update(&hash);
    }
    let pictures = PictureFolders::new(project);
    let (reads_images, reads_masks) = match settings.confidence.source {
        ConfidenceSource::None => (false, false),
        ConfidenceSource::Geometric => (false, true),
        ConfidenceSource::Photometric | ConfidenceSource::Auto => (true, true),
    };
    let of_view = |view: &View| {
        let [image, mask] = pictures.files(&view.name);
        let size = image.as_deref().and_then(size);
        let read = [image.filter(|_| reads_images), mask.filter(|_| reads_masks)];
        // The contents of a picture that cannot be read are left out.
        (size, read.map(|path| ends(&path?).ok()))
    };
    // Only reading is parallel: the hash depends on the order of the views.
    let of_views: Vec<_> = scene.views.par_iter().map(of_view).collect();
    for (view, (size, pictures)) in scene.views.iter().zip(of_views) {
        hasher
            .update(&(view.name.len() as u64).to_le_bytes())
            .update(view.name.as_bytes());
        // No file has this size: a missing image differs from an empty one.
        hasher.update(&size.unwrap_or(u64::MAX).to_le_bytes());
        for picture in pictures {
            hasher.update(&picture.map_or([0; blake3::OUT_LEN], |hash| *hash.as_bytes()));
        }
    }
    Ok(hasher.finalize().to_string())
}

/// Returns the files of the pilot's maps, by view, in a folder outside of the project.
fn maps_outside(project: &Project, scene: &Scene, settings: &Settings) -> Vec<PathBuf> {
    let folder = settings.pilot.maps.as_deref();
    let folder = folder.filter(|folder| is_outside(folder, &project.root));
    let found = folder.and_then(|folder| depthmaps::list(folder, scene).ok());
    let maps = found.into_iter().flat_map(|found| found.maps);
    maps.flat_map(|map| depthmaps::files_with_depths(&map))
        .collect()
}

/// Returns a hash of a file's length and of [`END`] bytes at its beginning and end.
fn ends(path: &Path) -> io::Result<blake3::Hash> {
    let mut file = input::open(path)?;
    let length = file.metadata()?.len();
    let mut hasher = blake3::Hasher::new();
    hasher.update(&length.to_le_bytes());
    io::copy(&mut (&file).take(END), &mut hasher)?;
    if length > END {
        // Never within the beginning, which is hashed already.
        file.seek(SeekFrom::Start(END.max(length - END)))?;
        io::copy(&mut file.take(END), &mut hasher)?;
    }
    Ok(hasher.finalize())
}

fn size(path: &Path) -> Option<u64> {
    fs::metadata(path).ok().map(|found| found.len())
}
