//! Locations of exports: one set of files per folder, and the files that an export must not
//! overwrite.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::{BackendError, Export, by_name};
use crate::{
    base::{
        input::{self, FileKind},
        paths::real,
    },
    io::{
        output::{self, FileSet, OutputError},
        project::{Project, ProjectError, slashes},
    },
};

/// Paths of the record of an export, and of its first tile.
const RECORDS: [&str; 4] = [
    "export.json",
    "stereo/viewrank/export.json",
    "tile_01/export.json",
    "tile_01/stereo/viewrank/export.json",
];

/// Returns the folder of the export whose record has this path, relative to the same folder, and
/// whether the export is tiled; `None` if the path is not that of a record.
pub fn folder_of_record(record: &str) -> Option<(&str, bool)> {
    let below = |name: &&str| {
        record
            .strip_suffix(*name)
            .filter(|folder| folder.is_empty() || folder.ends_with('/'))
    };
    let folder = RECORDS[..2]
        .iter()
        // The longer path first, since it ends with the shorter one.
        .rev()
        .find_map(below)?
        .trim_end_matches('/');
    Some(match folder.rsplit_once('/') {
        Some((above, tile)) if tile.starts_with("tile_") => (above, true),
        _ => (folder, false),
    })
}

/// Joins the files of exports below one folder, to be written together. Below the project they form
/// a set of the project, so that links stay within it. A later set of the same folder replaces only
/// this one.
pub fn set_of_folder(
    folder: &Path,
    parts: impl IntoIterator<Item = FileSet>,
    project: &Project,
) -> FileSet {
    let folder = place(folder, project);
    let (mut set, base) = match folder.strip_prefix(&project.home) {
        Ok(inner) => (FileSet::new(&project.home, &set_name(inner)), &project.home),
        Err(_) => (FileSet::new(&folder, &set_name(Path::new(""))), &folder),
    };
    for part in parts {
        let at = place(&part.root, project);
        let inner = slashes(at.strip_prefix(base).unwrap_or(&at));
        let path = |path: String| {
            if inner.is_empty() {
                path
            } else {
                format!("{inner}/{path}")
            }
        };
        set.files.extend(
            part.files
                .into_iter()
                .map(|(name, contents)| (path(name), contents)),
        );
    }
    set
}

/// The path below the project if it is one as written or through links, else the real one. A path
/// below the project stays one if somebody puts a link into it.
fn place(path: &Path, project: &Project) -> PathBuf {
    let inner = output::below(&project.home, path);
    let inner = inner.or_else(|| {
        Some(
            real(path)
                .strip_prefix(real(&project.home))
                .ok()?
                .to_path_buf(),
        )
    });
    inner.map_or_else(|| real(path), |inner| project.home.join(inner))
}

/// Returns the set's name: determined by the folder, with a fixed length.
fn set_name(inner: &Path) -> String {
    let hash = blake3::hash(inner.to_string_lossy().as_bytes()).to_hex();
    format!("export-{}", &hash[..16])
}

/// Refuses a folder of the project that a link leads out of it, a folder that is a file or contains
/// the export for another backend, and output among the project's own files.
pub fn check(folder: &Path, exports: &[Export], project: &Project) -> Result<(), BackendError> {
    output::refuse_to_leave(&project.home, folder)?;
    if let Some(file) = folder.ancestors().find(|above| above.is_file()) {
        return Err(OutputError::InTheWay {
            path: file.to_path_buf(),
            folder: false,
        }
        .into());
    }
    if folder.to_str().is_none() {
        let why = std::io::Error::new(
            std::io::ErrorKind::InvalidFilename,
            "a path that is not UTF-8",
        );
        return Err(ProjectError::io(folder)(why).into());
    }
    for Export { files, record } in exports {
        match earlier_backend(folder).filter(|earlier| *earlier != record.backend) {
            Some(earlier) => {
                return Err(BackendError::OtherExport {
                    folder: folder.into(),
                    backend: earlier,
                });
            }
            None => {
                spare_own_files(files, project)?;
                refuse_mixed_models(files)?;
            }
        }
    }
    Ok(())
}

/// Returns the backend of the export in the folder.
fn earlier_backend(folder: &Path) -> Option<String> {
    #[derive(Deserialize)]
    struct Record {
        backend: String,
    }
    let read = |name: &&str| {
        serde_json::from_slice::<Record>(&input::read(&folder.join(name), FileKind::Plan).ok()?)
            .ok()
    };
    let backend = RECORDS.iter().find_map(read)?.backend;
    // The record may be a link to anything, of which no word is said.
    let is_known = by_name(&backend).is_ok();
    Some(if is_known {
        backend
    } else {
        "another program".into()
    })
}

/// Refuses to write a COLMAP model next to rigs and frames of another one: ours has none, and
/// COLMAP 4 would read the others.
fn refuse_mixed_models(files: &FileSet) -> Result<(), BackendError> {
    let mut folders = files
        .files
        .keys()
        .filter_map(|name| name.strip_suffix("images.bin"));
    let other = |folder: &str| {
        let beside = ["rigs.bin", "frames.bin"].map(|name| files.root.join(folder).join(name));
        beside.into_iter().find(|path| path.exists())
    };
    folders
        .find_map(other)
        .map_or(Ok(()), |path| Err(BackendError::OtherModel(path)))
}

/// Refuses output among the images of the project or in place of its model: links to images would
/// be circular, and the next plan would read the model of the export.
fn spare_own_files(files: &FileSet, project: &Project) -> Result<(), BackendError> {
    let place = |path: &Path| match (path.parent(), path.file_name()) {
        (Some(folder), Some(name)) => real(folder).join(name),
        _ => real(path),
    };
    // A project folder with images directly in it is not only a folder of images.
    let images = project
        .images
        .as_deref()
        .map(real)
        .filter(|images| !real(&project.root).starts_with(images));
    let model: Vec<PathBuf> = project
        .model_files()
        .iter()
        .map(|file| place(file))
        .collect();
    let root = real(&files.root);
    let is_own = |path: &PathBuf| {
        let path = place(path);
        let is_model = model
            .iter()
            // Whatever the extension: COLMAP would take our `.bin` rather than the user's `.txt`.
            .any(|file| file.with_extension("") == path.with_extension(""));
        is_model
            || images
                .as_ref()
                .is_some_and(|images| path.starts_with(images))
    };
    match files.files.keys().map(|name| root.join(name)).find(is_own) {
        Some(path) => Err(BackendError::OwnFile(path)),
        None => Ok(()),
    }
}

/// Returns the relative path from a folder to an ancestor, so that both can be moved together; the
/// whole path if it isn't an ancestor.
pub(super) fn path_from(folder: &Path, above: &Path) -> PathBuf {
    let (folder, above) = (real(folder), real(above));
    match folder.strip_prefix(&above) {
        Ok(inner) if inner.as_os_str().is_empty() => ".".into(),
        Ok(inner) => inner.components().map(|_| "..").collect(),
        Err(_) => above,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_record_gives_the_folder_of_its_export() {
        for (record, found) in [
            (
                "viewrank/openmvs/export.json",
                Some(("viewrank/openmvs", false)),
            ),
            ("dense/stereo/viewrank/export.json", Some(("dense", false))),
            (
                "viewrank/colmap-tiles/tile_02/stereo/viewrank/export.json",
                Some(("viewrank/colmap-tiles", true)),
            ),
            (
                "viewrank/openmvs-tiles/tile_01/export.json",
                Some(("viewrank/openmvs-tiles", true)),
            ),
            ("export.json", Some(("", false))),
            ("viewrank/openmvs/my_export.json", None),
        ] {
            assert_eq!(folder_of_record(record), found, "{record}");
        }
    }
}
