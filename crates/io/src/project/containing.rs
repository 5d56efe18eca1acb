//! The project that a part of it belongs to, for people who name the part.

use std::path::{Path, PathBuf};

use super::{Project, discover, elsewhere, files::REQUIRED, image_files::is_image};
use crate::paths::is_same;

/// Files of a COLMAP model beside those that are required, without their extension.
const FURTHER: [&str; 2] = ["rigs", "frames"];

/// The project of a file of a COLMAP model, a database, an image, a plan, or a folder of sparse
/// models, images, results or an export among them; `None` if the path is a project or a model by
/// itself. A sub-model that is not the one with most images is a project of its own, as is one with
/// results or settings in its folder.
pub fn containing(path: &Path) -> Option<PathBuf> {
    let whole = std::path::absolute(path).ok()?;
    let part = if whole.is_dir() {
        whole.clone()
    } else {
        folder_of_file(&whole)?
    };
    let name = part.file_name()?.to_str()?;
    let is_model = || part != whole && !is_image(&whole) && !part.ends_with("viewrank");
    let found = project_of(&part, name).or_else(|| is_model().then(|| part.clone()))?;
    // Typed relative, answered relative.
    let levels = whole.components().count() - found.components().count();
    let typed = path
        .ancestors()
        .nth(levels)
        .filter(|typed| !typed.as_os_str().is_empty());
    Some(typed.map_or(found, Path::to_path_buf))
}

/// The project of a folder of this name.
fn project_of(part: &Path, name: &str) -> Option<PathBuf> {
    let is_project = |folder: &Path| discover::open(folder, None).is_ok();
    let above = part.parent()?;
    match name {
        "images" if is_project(part) => None,
        // Scenes of an export in it are no project of their own.
        "viewrank" if part.join("manifest.json").is_file() || !is_project(part) => {
            is_project(above).then(|| above.to_path_buf())
        }
        _ if is_export(part) && above.ends_with("viewrank") => {
            let home = above.parent()?;
            (is_project(home) || elsewhere::project_of(home).is_some()).then(|| home.to_path_buf())
        }
        "sparse" | "images" => project_above(part, above),
        // The images are beside it.
        _ if discover::FOLDERS_OF_PROGRAMS.contains(&name) => project_above(part, above),
        _ if above.ends_with("sparse") => project_of_sub_model(part, above.parent()?),
        _ => None,
    }
}

/// The project of a model in the `sparse` of a folder: that above a folder of a program, or the
/// folder itself.
fn project_of_sub_model(part: &Path, folder: &Path) -> Option<PathBuf> {
    let is_of_program = discover::FOLDERS_OF_PROGRAMS
        .iter()
        .any(|name| folder.file_name().is_some_and(|own| own == *name));
    let project = folder.parent().filter(|_| is_of_program);
    project
        .and_then(|project| project_above(part, project))
        .or_else(|| project_above(part, folder))
}

fn is_export(folder: &Path) -> bool {
    ["export.json", "stereo/viewrank/export.json"]
        .iter()
        .any(|record| folder.join(record).is_file())
}

/// The folder of a model's file or of a database.
fn folder_of_file(path: &Path) -> Option<PathBuf> {
    let (stem, extension) = (path.file_stem()?.to_str()?, path.extension()?.to_str()?);
    let is_model = ["bin", "txt"].contains(&extension)
        && REQUIRED.iter().chain(&FURTHER).any(|name| *name == stem);
    let is_database = extension == "db";
    let folder = path.parent()?;
    let is_image = is_image(path) && folder.ends_with("images");
    let is_plan = folder.ends_with("viewrank") && path.is_file();
    ((is_model || is_database || is_image || is_plan) && folder.is_dir())
        .then(|| folder.to_path_buf())
}

fn project_above(part: &Path, above: &Path) -> Option<PathBuf> {
    if part.join("viewrank").exists() || part.join("viewrank.toml").exists() {
        return None;
    }
    let Project { model, .. } = discover::open(above, None).ok()?;
    let mut above_model = model.path.ancestors().take(3);
    let holds_model = above_model.any(|folder| is_same(folder, part));
    (holds_model || part.ends_with("images")).then(|| above.to_path_buf())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fixture() -> PathBuf {
        Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../..")).join("fixtures/valley")
    }

    #[test]
    fn parts_of_a_project_lead_to_it() {
        let project = fixture();
        for part in ["sparse", "images", "sparse/points3D.bin"] {
            let part = project.join(part);
            if part.exists() {
                assert_eq!(
                    containing(&part),
                    Some(project.clone()),
                    "{}",
                    part.display()
                );
            }
        }
        let image = std::fs::read_dir(project.join("images"))
            .unwrap()
            .next()
            .unwrap()
            .unwrap()
            .path();
        assert_eq!(containing(&image), Some(project.clone()));
        assert_eq!(containing(&project), None);
    }

    #[test]
    fn a_sub_model_with_results_and_a_smaller_one_are_projects_by_themselves() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        let model = discover::open(&fixture(), None).unwrap().model.path;
        let copy = |to: &Path| {
            std::fs::create_dir_all(to).unwrap();
            for entry in std::fs::read_dir(&model)
                .unwrap()
                .map(Result::unwrap)
                .filter(|e| e.path().is_file())
            {
                std::fs::copy(entry.path(), to.join(entry.file_name())).unwrap();
            }
        };
        copy(&root.join("sparse/0"));
        copy(&root.join("sparse/1"));
        std::fs::write(root.join("database.db"), "").unwrap();
        assert_eq!(containing(&root.join("sparse/0")), Some(root.into()));
        assert_eq!(
            containing(&root.join("sparse/0/points3D.bin")),
            Some(root.into())
        );
        assert_eq!(containing(&root.join("database.db")), Some(root.into()));
        assert_eq!(containing(&root.join("sparse/1")), None);
        std::fs::create_dir(root.join("viewrank")).unwrap();
        std::fs::write(root.join("viewrank/manifest.json"), "").unwrap();
        assert_eq!(containing(&root.join("viewrank")), Some(root.into()));
        assert_eq!(
            containing(&root.join("viewrank/manifest.json")),
            Some(root.into())
        );
        std::fs::create_dir(root.join("viewrank/openmvs")).unwrap();
        std::fs::write(root.join("viewrank/openmvs/export.json"), "").unwrap();
        assert_eq!(
            containing(&root.join("viewrank/openmvs")),
            Some(root.into())
        );
        std::fs::create_dir(root.join("sparse/0/viewrank")).unwrap();
        assert_eq!(containing(&root.join("sparse/0")), None);
    }
}
