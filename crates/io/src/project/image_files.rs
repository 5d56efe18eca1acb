//! Image files by their names: which files are images, and all images below a folder.

use std::{collections::HashSet, ffi::OsStr, path::Path};

use walkdir::WalkDir;

use super::MASKS;
use crate::paths::stem;

/// Extensions of image files, lower case.
pub(super) const EXTENSIONS: [&str; 10] = [
    "jpg", "jpeg", "png", "tif", "tiff", "bmp", "ppm", "pgm", "webp", "jp2",
];
/// How the name of a mask ends where it is beside its image.
const MASK: &str = "mask";
/// Most files and folders that are looked through: a project's settings may name any folder.
pub(super) const MOST_ENTRIES: usize = 500_000;

/// Returns the images in a folder and its sub-folders whose path, relative to it, `is_wanted`;
/// sorted. Links to folders are not followed: they may lead anywhere. Hidden folders hold
/// programs' own copies.
pub fn images_below(folder: &Path, is_wanted: impl Fn(&Path) -> bool) -> Vec<String> {
    let entries = WalkDir::new(folder)
        // This folder was chosen, even if it is a link.
        .follow_root_links(true)
        .sort_by_file_name()
        .into_iter()
        .filter_entry(|entry| entry.depth() == 0 || !is_hidden(entry.file_name()))
        .take(MOST_ENTRIES);
    let images = entries
        .filter_map(Result::ok)
        // Also through a link: images are often links to a store.
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
    // The walk sorts within each folder: it has `a/b` before `a-b`.
    wanted.sort_unstable();
    wanted
}

fn is_hidden(name: &OsStr) -> bool {
    name.as_encoded_bytes().starts_with(b".")
}

/// True for names of image files; hidden ones are none (`._a.jpg`, which macOS writes beside
/// `a.jpg`).
pub fn is_image(path: &Path) -> bool {
    if path.file_name().is_none_or(is_hidden) {
        return false;
    }
    let extension = path
        .extension()
        .map(|e| e.to_string_lossy().to_ascii_lowercase());
    extension.is_some_and(|e| EXTENSIONS.contains(&e.as_str()))
}

/// The images of a folder that are no masks of others in it: `a_mask.png`, `a.mask.png`,
/// `a.jpg.mask.png`, `a.jpg.png` and `masks/a.png` are masks of `a.jpg`, wherever that is. Alone
/// they may be photographs.
pub(super) fn without_masks(images: Vec<String>) -> Vec<String> {
    let names: HashSet<&str> = images.iter().map(String::as_str).collect();
    let stems: HashSet<&str> = images.iter().map(|name| stem(name)).collect();
    let is_there = |image: &String| {
        names.contains(&**image) || stems.contains(&**image) && !is_image(Path::new(image))
    };
    let is_mask: Vec<bool> = images
        .iter()
        .map(|name| masked(name).iter().any(is_there))
        .collect();
    let images = images.into_iter().zip(is_mask);
    images
        .filter(|(_, is_mask)| !is_mask)
        .map(|(name, _)| name)
        .collect()
}

/// Names of the images, with or without extension, that a file may be the mask of by its own.
fn masked(name: &str) -> Vec<String> {
    let stem = stem(name);
    let unmarked = strip_mark(stem);
    let image = Some(stem).filter(|stem| is_image(Path::new(stem)));
    let beside = [unmarked, image].into_iter().flatten().map(String::from);
    let Some((folder, last)) = stem.rsplit_once('/') else {
        return beside.collect();
    };
    let (above, folder) = folder.rsplit_once('/').unwrap_or(("", folder));
    let is_of_masks = [MASK, MASKS]
        .iter()
        .any(|of| folder.eq_ignore_ascii_case(of));
    let lasts = [Some(last), strip_mark(last)].into_iter().flatten();
    let above = lasts.filter(|_| is_of_masks).map(|last| match above {
        "" => last.into(),
        above => format!("{above}/{last}"),
    });
    beside.chain(above).collect()
}

/// The stem without the mark of a mask at its end.
fn strip_mark(stem: &str) -> Option<&str> {
    // The cut may fall within a character of a name that is no mask's.
    let (rest, mark) = stem.split_at_checked(stem.len().checked_sub(MASK.len())?)?;
    let rest = rest.strip_suffix(['_', '-', '.'])?;
    (mark.eq_ignore_ascii_case(MASK) && !rest.is_empty()).then_some(rest)
}

/// Formats a path with `/` as the separator, like image names.
pub fn slashes(path: &Path) -> String {
    path.components()
        .map(|c| c.as_os_str().to_string_lossy())
        .collect::<Vec<_>>()
        .join("/")
}
