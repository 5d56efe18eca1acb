//! Image files by their names: which files are images, and all images below a folder.

use std::path::Path;

use walkdir::WalkDir;

/// Extensions of image files, lower case.
pub(super) const EXTENSIONS: [&str; 10] = [
    "jpg", "jpeg", "png", "tif", "tiff", "bmp", "ppm", "pgm", "webp", "jp2",
];
/// Most files and folders that are looked through: a project's settings may name any folder.
pub(super) const MOST_ENTRIES: usize = 500_000;

/// Returns the images in a folder and its sub-folders whose path, relative to it, `is_wanted`;
/// sorted. Links to folders are not followed: they may lead anywhere.
pub fn images_below(folder: &Path, is_wanted: impl Fn(&Path) -> bool) -> Vec<String> {
    let entries = WalkDir::new(folder)
        .follow_root_links(true)
        .sort_by_file_name()
        .into_iter()
        .take(MOST_ENTRIES);
    let images = entries
        .filter_map(Result::ok)
        .filter(|entry| is_image(entry.path()) && entry.path().is_file());
    let names = images.filter_map(|entry| {
        entry
            .path()
            .strip_prefix(folder)
            .ok()
            .map(Path::to_path_buf)
    });
    let mut wanted: Vec<String> = names
        .filter(|name| is_wanted(name))
        .map(|name| slashes(&name))
        .collect();
    wanted.sort_unstable();
    wanted
}

/// True for names of image files; hidden ones are none (`._a.jpg`, which macOS writes beside
/// `a.jpg`).
pub fn is_image(path: &Path) -> bool {
    let is_hidden = |name: &std::ffi::OsStr| name.as_encoded_bytes().starts_with(b".");
    if path.file_name().is_none_or(is_hidden) {
        return false;
    }
    let extension = path
        .extension()
        .map(|e| e.to_string_lossy().to_ascii_lowercase());
    extension.is_some_and(|e| EXTENSIONS.contains(&e.as_str()))
}

/// Formats a path with `/` as the separator, like image names.
pub fn slashes(path: &Path) -> String {
    path.components()
        .map(|c| c.as_os_str().to_string_lossy())
        .collect::<Vec<_>>()
        .join("/")
}
