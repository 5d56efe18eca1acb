//! The image folder of a project.

use std::{
    collections::HashSet,
    path::{Path, PathBuf},
};

use walkdir::WalkDir;

use crate::scene::Scene;

/// Extensions of images, lower case.
const EXTENSIONS: [&str; 10] = ["jpg", "jpeg", "png", "tif", "tiff", "bmp", "ppm", "pgm", "webp", "jp2"];

/// The folder that names of the model are relative to: what the model's own `project.ini` says, else the nearest `images`.
pub(super) fn find(root: &Path, model: &Path) -> Option<PathBuf> {
    let up = |levels: usize| model.ancestors().nth(levels).map(|folder| folder.join("images"));
    let candidates = [Some(root.join("images")), said_by_colmap(model), up(0), up(1), up(2)];
    candidates.into_iter().flatten().find(|folder| folder.is_dir())
}

/// `image_path` of the settings that COLMAP leaves beside a model.
fn said_by_colmap(model: &Path) -> Option<PathBuf> {
    let settings = std::fs::read_to_string(model.join("project.ini")).ok()?;
    let value = settings.lines().find_map(|line| line.trim().strip_prefix("image_path")?.trim().strip_prefix('='))?;
    Some(model.join(value.trim()))
}

/// Images of the folder that the scene has no view of, sorted.
pub(super) fn unregistered(folder: &Path, scene: &Scene) -> Vec<String> {
    let registered: HashSet<PathBuf> = scene.views.iter().map(|view| normal(Path::new(&view.name))).collect();
    let files = WalkDir::new(folder).follow_links(true).into_iter().filter_map(Result::ok);
    let images = files.filter(|entry| entry.file_type().is_file() && is_image(entry.path()));
    let names = images.filter_map(|entry| entry.path().strip_prefix(folder).ok().map(Path::to_path_buf));
    let mut left: Vec<String> = names.filter(|name| !registered.contains(name)).map(slashes).collect();
    left.sort_unstable();
    left
}

fn is_image(path: &Path) -> bool {
    let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
    extension.is_some_and(|e| EXTENSIONS.contains(&e.as_str()))
}

/// Without `.` components.
fn normal(name: &Path) -> PathBuf {
    name.components().filter(|c| !matches!(c, std::path::Component::CurDir)).collect()
}

fn slashes(name: PathBuf) -> String {
    name.components().map(|c| c.as_os_str().to_string_lossy()).collect::<Vec<_>>().join("/")
}
