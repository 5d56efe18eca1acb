//! The image folder of a project, found by the names in the model, and the files of images whose
//! names are spelled otherwise there.

use std::{
    collections::{BTreeMap, HashMap},
    ops::Deref,
    path::{Path, PathBuf},
    sync::{Arc, OnceLock},
};

use viewrank_core::model::scene::Scene;
use walkdir::{DirEntry, WalkDir};

use super::image_files::{is_image, slashes};
use crate::{
    input::{self, FileKind},
    output::Contents,
};

/// Name of a folder of masks: in the project, beside its image folder or in that.
pub const MASKS: &str = "masks";
/// Depth below a folder to which other folders of images are searched.
const DEPTH: usize = 2;
/// Most folders that are searched.
const MOST_FOLDERS: usize = 2000;
/// Folders that hold images of these names which are no photographs of the model: results of
/// viewrank and of MVS programs, reduced copies.
const NOT_SEARCHED: [&str; 9] = [
    "viewrank",
    "dense",
    "stereo",
    MASKS,
    "sparse",
    "undistorted",
    "thumbnails",
    "depth_maps",
    "export",
];

/// Folder to which the image names of a model are relative. Dereferences to its path.
#[derive(Clone, Debug)]
pub struct ImageFolder {
    path: PathBuf,
    /// The path is neither given by the user or the model nor one of the usual places.
    pub is_searched: bool,
    /// Paths relative to the folder, by name in the model, of images that are not there under that
    /// name. Known once the model is read.
    others: Arc<OnceLock<BTreeMap<String, String>>>,
}

impl ImageFolder {
    pub fn new(path: impl Into<PathBuf>) -> Self {
        Self {
            path: path.into(),
            is_searched: false,
            others: Arc::default(),
        }
    }

    /// Path of an image's file, whether it exists or not.
    pub fn file(&self, name: &str) -> PathBuf {
        let other = self.others.get().and_then(|others| others.get(name));
        self.path.join(other.map_or(name, String::as_str))
    }

    /// An image among the files of an export.
    pub fn link(&self, name: &str) -> Contents {
        Contents::Link {
            file: self.file(name),
            folder: self.path.clone(),
        }
    }

    /// Name in the model and path in the folder of each image that is there under another name, by
    /// name.
    pub fn other_names(&self) -> impl Iterator<Item = (&str, &str)> {
        self.others
            .get()
            .into_iter()
            .flatten()
            .map(|(name, other)| (name.as_str(), other.as_str()))
    }

    /// Finds the files of images that are not in the folder under their names: in other case, with
    /// another extension of images, or in another sub-folder if only one has a file of that name.
    pub(super) fn resolve(&self, scene: &Scene) {
        let is_missing = |name: &&str| !self.path.join(name).exists();
        let missing: Vec<&str> = scene
            .views
            .iter()
            .map(|view| &*view.name)
            .filter(is_missing)
            .collect();
        _ = self.others.set(if missing.is_empty() {
            BTreeMap::new()
        } else {
            Index::new(&self.path).resolve(&missing)
        });
    }
}

impl<P: Into<PathBuf>> From<P> for ImageFolder {
    fn from(path: P) -> Self {
        Self::new(path)
    }
}

impl Deref for ImageFolder {
    type Target = Path;

    fn deref(&self) -> &Path {
        &self.path
    }
}

impl AsRef<Path> for ImageFolder {
    fn as_ref(&self) -> &Path {
        &self.path
    }
}

/// The images below a folder by simplified names; `None` where several have the same.
struct Index {
    by_path: HashMap<String, Option<String>>,
    by_name: HashMap<String, Option<String>>,
}

impl Index {
    fn new(folder: &Path) -> Self {
        let mut index = Self {
            by_path: HashMap::new(),
            by_name: HashMap::new(),
        };
        let files = WalkDir::new(folder)
            .follow_links(true)
            .sort_by_file_name()
            .into_iter();
        let files = files
            .filter_entry(|entry| entry.depth() == 0 || !is_skipped(entry))
            .filter_map(Result::ok);
        for entry in files.filter(|entry| entry.file_type().is_file() && is_image(entry.path())) {
            let Ok(path) = entry.path().strip_prefix(folder) else {
                continue;
            };
            let path = slashes(path);
            let note = |of: &mut HashMap<String, Option<String>>, key: String| {
                of.entry(key)
                    .and_modify(|known| *known = None)
                    .or_insert_with(|| Some(path.clone()));
            };
            note(&mut index.by_path, simplified(&path));
            note(&mut index.by_name, simplified(last(&path)));
        }
        index
    }

    fn resolve(&self, missing: &[&str]) -> BTreeMap<String, String> {
        let by_path = |name: &str| self.by_path.get(&simplified(name)).cloned().flatten();
        let by_name = |name: &str| self.by_name.get(&simplified(last(name))).cloned().flatten();
        // Images of one name in several folders of the model are told apart by their folders alone.
        let mut sharing: HashMap<String, usize> = HashMap::new();
        missing
            .iter()
            .for_each(|name| *sharing.entry(simplified(last(name))).or_default() += 1);
        let found = |name: &&str| {
            let alone = sharing.get(&simplified(last(name))) == Some(&1);
            let file = by_path(name).or_else(|| by_name(name).filter(|_| alone))?;
            Some(((*name).to_owned(), file))
        };
        missing.iter().filter_map(found).collect()
    }
}

fn last(path: &str) -> &str {
    path.rsplit('/').next().unwrap_or(path)
}

/// A name in lower case without its extension.
fn simplified(name: &str) -> String {
    let stem = name.rsplit_once('.').map_or(name, |(stem, _)| stem);
    stem.trim_start_matches("./").to_lowercase()
}

fn is_skipped(entry: &DirEntry) -> bool {
    let name = entry.file_name().to_string_lossy();
    let is_reduced = name
        .strip_prefix("images_")
        .is_some_and(|factor| factor.parse::<u32>().is_ok());
    entry.file_type().is_dir()
        && (name.starts_with('.') || is_reduced || NOT_SEARCHED.contains(&&*name))
}

/// Existing folders to which the model's image names may be relative, best first: the nearest
/// `images`, the image path in the model's `project.ini`, the project folder and the model's
/// folder.
pub(super) fn candidates(root: &Path, model: &Path) -> Vec<PathBuf> {
    let up = |levels: usize| {
        model
            .ancestors()
            .nth(levels)
            .map(|folder| folder.join("images"))
    };
    let named = [
        up(0),
        up(1),
        up(2),
        Some(root.join("images")),
        colmap_image_path(model),
    ];
    let bare = [Some(root.into()), model.parent().map(Path::to_path_buf)];
    named
        .into_iter()
        .chain(bare)
        .flatten()
        .filter(|folder| folder.is_dir())
        .collect()
}

/// `image_path` of the `project.ini` that COLMAP writes next to a model.
fn colmap_image_path(model: &Path) -> Option<PathBuf> {
    let settings = input::read_text(&model.join("project.ini"), FileKind::Settings).ok()?;
    let value = settings.lines().find_map(|line| {
        line.trim()
            .strip_prefix("image_path")?
            .trim()
            .strip_prefix('=')
    })?;
    Some(model.join(value.trim()))
}

/// Finds the image folder: the first usual place that holds one of the `names`, else the folder
/// below the project, or next to the model's folder, that holds most of them, else the usual place
/// that exists. `named`: the folder that the model names.
pub(super) fn find(
    root: &Path,
    model: &Path,
    named: Option<PathBuf>,
    names: &[String],
) -> Option<ImageFolder> {
    let is_own = |folder: &Path| folder == root || model.starts_with(folder);
    let usual: Vec<PathBuf> = named.into_iter().chain(candidates(root, model)).collect();
    let holds_one = |folder: &&PathBuf| names.iter().any(|name| folder.join(name).is_file());
    if let Some(folder) = usual.iter().find(holds_one) {
        return Some(ImageFolder::new(folder));
    }
    let searched = searched(root, names).map(|path| ImageFolder {
        is_searched: true,
        ..ImageFolder::new(path)
    });
    let by_place = || {
        usual
            .iter()
            .find(|folder| !is_own(folder))
            .map(ImageFolder::new)
    };
    // If no folder has any of the images, names the usual one, where the user should put them.
    searched.or_else(by_place)
}

/// The folder with most of the images, in any spelling; of equal ones the first by path.
fn searched(root: &Path, names: &[String]) -> Option<PathBuf> {
    if names.is_empty() {
        return None;
    }
    let folders = WalkDir::new(root)
        .max_depth(DEPTH)
        .follow_links(false)
        .sort_by_file_name()
        .into_iter();
    let folders = folders
        .filter_entry(|entry| entry.depth() == 0 || !is_skipped(entry))
        .filter_map(Result::ok);
    let folders = folders
        .filter(|entry| entry.file_type().is_dir())
        .map(DirEntry::into_path)
        .take(MOST_FOLDERS);
    let held = |folder: &Path| {
        let exact = names
            .iter()
            .filter(|name| folder.join(name).is_file())
            .count();
        if exact > 0 {
            exact
        } else {
            spelled_otherwise(folder, names)
        }
    };
    let mut best: Option<(usize, PathBuf)> = None;
    for folder in folders {
        let count = held(&folder);
        if count > best.as_ref().map_or(0, |(most, _)| *most) {
            best = Some((count, folder));
        }
    }
    best.map(|(_, folder)| folder)
}

/// Number of names that have a file directly in the folder but for case and extension.
fn spelled_otherwise(folder: &Path, names: &[String]) -> usize {
    let files = std::fs::read_dir(folder)
        .into_iter()
        .flatten()
        .filter_map(Result::ok)
        .map(|entry| entry.path());
    let there: Vec<String> = files
        .filter(|path| is_image(path))
        .filter_map(|path| Some(simplified(path.file_name()?.to_str()?)))
        .collect();
    names
        .iter()
        .filter(|name| there.contains(&simplified(last(name))))
        .count()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder_with(files: &[&str]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for file in files {
            let path = folder.path().join(file);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, "image").unwrap();
        }
        folder
    }

    fn found(files: &[&str], names: &[&str]) -> Option<(String, bool)> {
        let folder = folder_with(files);
        let root = folder.path();
        std::fs::create_dir_all(root.join("sparse/0")).unwrap();
        let names: Vec<String> = names.iter().map(|name| (*name).to_owned()).collect();
        let found = find(root, &root.join("sparse/0"), None, &names)?;
        Some((
            slashes(found.strip_prefix(root).unwrap()),
            found.is_searched,
        ))
    }

    #[test]
    fn images_are_found_where_they_are() {
        let two = ["a.jpg", "b.jpg"];
        assert_eq!(
            found(&["images/a.jpg", "photos/b.jpg"], &two),
            Some(("images".into(), false))
        );
        assert_eq!(
            found(&["photos/a.jpg", "photos/b.jpg"], &two),
            Some(("photos".into(), true))
        );
        assert_eq!(
            found(&["images/flight 1/a.jpg"], &two),
            Some(("images/flight 1".into(), true))
        );
        assert_eq!(
            found(&["raw/a.JPG", "raw/b.JPG", "some/a.jpg"], &two),
            Some(("raw".into(), true))
        );
        assert_eq!(
            found(&["images/other.jpg"], &two),
            Some(("images".into(), false)),
            "to be put there"
        );
        let results = [
            "viewrank/openmvs/a.jpg",
            "dense/images/a.jpg",
            "images_4/a.jpg",
            ".trash/a.jpg",
        ];
        assert_eq!(found(&results, &two), None);
    }

    #[test]
    fn files_of_another_spelling_are_those_of_the_model() {
        let folder = folder_with(&[
            "A.JPG",
            "cam2/b.jpeg",
            "x/c.jpg",
            "y/c.jpg",
            "x/d.png",
            "y/e.jpg",
        ]);
        let names = [
            "a.jpg", "b.jpg", "c.jpg", "x/d.jpg", "p/e.jpg", "q/e.jpg", "f.jpg",
        ];
        let others = Index::new(folder.path()).resolve(&names);
        let others: Vec<_> = others
            .iter()
            .map(|(name, file)| (name.as_str(), file.as_str()))
            .collect();
        assert_eq!(
            others,
            [
                ("a.jpg", "A.JPG"),
                ("b.jpg", "cam2/b.jpeg"),
                ("x/d.jpg", "x/d.png")
            ]
        );
    }
}
