//! The image folder of a project, found by the names in the model, and the files of images whose
//! names are spelled otherwise there.

use std::{
    cmp::Reverse,
    collections::{HashMap, HashSet},
    ops::Deref,
    path::{Path, PathBuf},
    sync::{Arc, OnceLock},
};

use walkdir::{DirEntry, WalkDir};

use super::{
    image_files::{MOST_ENTRIES, images_below, is_image},
    names::{Names, last, take_names_of_files},
    other_names::{Others, others},
    probe::kind_by_header,
};
use crate::{
    formats::colmap::ColmapModel,
    input::{self, FileKind},
    output::Contents,
};

/// Name of a folder of masks: in the project, beside its image folder or in that.
pub const MASKS: &str = "masks";
/// Usual name of the folder of images.
const IMAGES: &str = "images";
/// Where the scripts of 3D Gaussian Splatting keep the photographs, and where their model.
pub(super) const INPUT: &str = "input";
pub(super) const DISTORTED: &str = "distorted";
/// Depth below a folder to which other folders of images are searched.
const DEPTH: usize = 2;
/// Most parts of the path in a `project.ini` that are taken from its end.
const MOST_PARTS: usize = 16;
/// Most folders that are searched.
const MOST_FOLDERS: usize = 2000;
/// Folders that hold images of these names which are no photographs of the model: results of
/// viewrank and of MVS programs, reduced copies.
const NOT_SEARCHED: [&str; 13] = [
    // Synology's thumbnails.
    "@eaDir",
    "preview",
    "previews",
    "thumbs",
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

/// First words of the names of folders whose images programs have made from photographs.
const RESULTS: [&str; 17] = [
    "annotation",
    "annotations",
    "blurred",
    "confidence",
    "depth",
    "depthmaps",
    "depths",
    "labels",
    "mask",
    "masks",
    "normal",
    "normals",
    "seg",
    "segmentation",
    "segmentations",
    "thumbnails",
    "thumbs",
];

/// Folder to which the image names of a model are relative. Dereferences to its path.
#[derive(Clone, Debug)]
pub struct ImageFolder {
    path: PathBuf,
    /// The path is neither given by the user or the model nor one of the usual places.
    pub is_searched: bool,
    /// Other folders whose images have the same names, and may as well be meant.
    pub rivals: Vec<PathBuf>,
    /// The images that are not there under their names. Known once the model is read.
    others: Arc<OnceLock<Others>>,
    /// The masks that the model names, by the names of their images. Known once the model is read.
    masks: Arc<OnceLock<HashMap<String, PathBuf>>>,
}

impl ImageFolder {
    pub fn new(path: impl Into<PathBuf>) -> Self {
        Self {
            path: path.into(),
            is_searched: false,
            rivals: Vec::new(),
            // Shared by clones, one of which finds them when it reads the model.
            others: Arc::default(),
            masks: Arc::default(),
        }
    }

    /// Path of an image's file, whether it exists or not.
    pub fn file(&self, name: &str) -> PathBuf {
        self.path.join(self.path_of(name))
    }

    /// Path of an image's file in the folder, whether it exists or not.
    pub fn path_of<'a>(&'a self, name: &'a str) -> &'a str {
        self.other_name(name).unwrap_or(name)
    }

    /// Path in the folder of an image that is there under another name.
    pub fn other_name(&self, name: &str) -> Option<&str> {
        let others = self.others.get()?;
        others.found.get(name).map(String::as_str)
    }

    /// Path of the mask that the model names for an image, whether it exists or not.
    pub fn mask(&self, name: &str) -> Option<&Path> {
        self.masks.get()?.get(name).map(PathBuf::as_path)
    }

    /// Returns whether the model names masks.
    pub fn has_masks(&self) -> bool {
        self.masks.get().is_some_and(|masks| !masks.is_empty())
    }

    /// Notes the masks that the model names.
    pub(super) fn add_masks(&self, masks: HashMap<String, PathBuf>) {
        self.masks.get_or_init(|| masks);
    }

    /// Two files in the folder of which either may be that of a missing image.
    pub fn candidates_for(&self, name: &str) -> Option<&[String; 2]> {
        self.others.get()?.ambiguous.get(name)
    }

    /// The files of all [`Self::candidates_for`].
    pub fn candidates(&self) -> impl Iterator<Item = &str> {
        let ambiguous = self
            .others
            .get()
            .into_iter()
            .flat_map(|others| others.ambiguous.values());
        ambiguous.flatten().map(String::as_str)
    }

    /// The name with the extension of its file, which programs may go by.
    pub fn name_of_kind(&self, name: &str) -> String {
        let extension = |name: &str| Some(Path::new(name).extension()?.to_str()?.to_owned());
        let Some(kind) = self.other_name(name).and_then(extension) else {
            return name.into();
        };
        match extension(name).filter(|_| is_image(Path::new(name))) {
            Some(own) if own.eq_ignore_ascii_case(&kind) => name.into(),
            Some(own) => format!("{}{kind}", &name[..name.len() - own.len()]),
            None => format!("{name}.{kind}"),
        }
    }

    /// The first image in the folder, by name, whether the model knows it or not.
    pub fn first_image(&self) -> Option<String> {
        images_below(&self.path, |name| !name.starts_with(MASKS))
            .into_iter()
            .next()
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
            .flat_map(|others| &others.found)
            .map(|(name, other)| (name.as_str(), other.as_str()))
            // A link that leads nowhere is found by its name.
            .filter(|(name, other)| name != other)
    }

    /// Gives the images of a model the names under which the folder has their files, and finds the
    /// files of those that are not there under their names: spelled otherwise, or in another
    /// sub-folder if only one has a file of that name. No file is that of two images.
    pub(super) fn name_images(&self, model: &mut ColmapModel) {
        let spelled = take_names_of_files(model, Some(&self.path));
        self.others.get_or_init(|| {
            let names = model.images.iter().map(|image| &*image.name);
            // An image that was given another name has its file under its former one.
            let is_missing =
                |name: &&str| spelled.contains_key(*name) || !self.path.join(name).exists();
            let (missing, there): (Vec<&str>, Vec<&str>) = names.partition(is_missing);
            let path = |name| spelled.get(name).map_or(name, String::as_str);
            let missing: Vec<(&str, &str)> =
                missing.into_iter().map(|name| (name, path(name))).collect();
            if missing.is_empty() {
                Others::default()
            } else {
                others(&self.path, &missing, &there)
            }
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

pub(super) fn is_skipped(entry: &DirEntry) -> bool {
    entry.file_type().is_dir() && holds_no_photographs(&entry.file_name().to_string_lossy())
}

/// Returns whether a folder of this name holds no photographs of a model, but copies and results.
pub(super) fn holds_no_photographs(name: &str) -> bool {
    let is_reduced = name
        .strip_prefix("images_")
        .is_some_and(|factor| factor.parse::<u32>().is_ok());
    name.starts_with('.') || is_reduced || NOT_SEARCHED.contains(&name)
}

/// Existing folders to which the model's image names may be relative, best first: the usual places,
/// then reduced copies of the images.
pub(super) fn candidates(root: &Path, model: &Path) -> Vec<PathBuf> {
    [usual(root, model), reduced(root, model)].concat()
}

/// The photographs of a distorted model of 3D Gaussian Splatting, the nearest `images`, those of
/// the nearest `project.ini`, the project folder and the model's folder, where they exist.
fn usual(root: &Path, model: &Path) -> Vec<PathBuf> {
    let bare = [Some(root.into()), model.parent().map(Path::to_path_buf)];
    let images = around(root, model).map(|above| Some(above.join(IMAGES)));
    [input_of(model)]
        .into_iter()
        .chain(images)
        .chain(of_settings(root, model).into_iter().map(Some))
        .chain(bare)
        .flatten()
        .filter(|folder| folder.is_dir())
        .collect()
}

/// The folder of the photographs of a model that the scripts of 3D Gaussian Splatting have
/// undistorted: `images` beside its own has the result.
fn input_of(model: &Path) -> Option<PathBuf> {
    let mut above = model.ancestors().take(DEPTH + 1);
    let own = above.find(|folder| folder.ends_with(DISTORTED))?;
    Some(own.parent()?.join(INPUT))
}

/// Folders of reduced copies of the images (`images_2`), the nearest first, of those the largest.
fn reduced(root: &Path, model: &Path) -> Vec<PathBuf> {
    let names = Names::new();
    let of = |above: &Path| -> Vec<PathBuf> {
        let reduced = names.reduced_in(above, IMAGES).into_iter();
        reduced.map(|name| above.join(name)).collect()
    };
    around(root, model).flat_map(of).collect()
}

/// Folders in which the images of a model usually have theirs.
fn around<'a>(root: &'a Path, model: &'a Path) -> impl Iterator<Item = &'a Path> {
    model.ancestors().take(3).chain([root])
}

/// The folders that may be meant by the nearest `project.ini`, which COLMAP writes next to a model:
/// its path is that of the machine and the working directory in which COLMAP ran, so that it counts
/// from each folder above the model, and what it ends with from the project.
fn of_settings(root: &Path, model: &Path) -> Vec<PathBuf> {
    let Some(path) = around(root, model).find_map(colmap_image_path) else {
        return Vec::new();
    };
    let as_it_is = around(root, model).map(|above| above.join(&path));
    let ends = path.rmatch_indices('/').take(MOST_PARTS);
    // A doubled slash would make the rest absolute, and `join` would drop the root.
    let ends = ends.map(|(at, _)| root.join(path[at + 1..].trim_start_matches('/')));
    let ends: Vec<PathBuf> = ends.collect();
    as_it_is.chain(ends.into_iter().rev()).collect()
}

/// `image_path` in the `project.ini` of a folder.
fn colmap_image_path(folder: &Path) -> Option<String> {
    let settings = input::read_text(&folder.join("project.ini"), FileKind::Settings).ok()?;
    let value = settings.lines().find_map(|line| {
        line.trim()
            .strip_prefix("image_path")?
            .trim()
            .strip_prefix('=')
    })?;
    let path = value.trim().replace('\\', "/");
    let path = path.trim_end_matches('/');
    (!path.is_empty()).then(|| path.into())
}

/// What is known of a model's images before they are found.
pub(super) struct SoughtImages {
    /// Names of the first.
    pub names: Vec<String>,
    /// Width and height of the cameras; none where they are unknown.
    pub sizes: HashSet<[u32; 2]>,
}

impl SoughtImages {
    /// Returns whether so many of the names are enough: where more are missing, they are elsewhere.
    fn are_most(&self, held: usize) -> bool {
        held * 4 >= self.names.len() * 3
    }
}

/// Finds the image folder: the first usual place that holds one of the `names`, if it holds most
/// and has pictures of the cameras' size; else, of the usual places and the folders below the
/// project, the one that holds most of them, under their names if any is, else spelled otherwise,
/// and of several the one with the best [`Look`]; else a reduced copy; else the usual place that
/// exists, where the user should put them. `named`: the folder that the model names.
pub(super) fn find(
    root: &Path,
    model: &Path,
    named: Option<PathBuf>,
    sought: &SoughtImages,
) -> Option<ImageFolder> {
    let names = &sought.names;
    let usual: Vec<PathBuf> = named.into_iter().chain(usual(root, model)).collect();
    let holds_one = |folder: &&PathBuf| names.iter().any(|name| folder.join(name).is_file());
    let holds_most = |folder: &&PathBuf| {
        let there = names.iter().filter(|name| folder.join(name).is_file());
        sought.are_most(there.count())
    };
    // One that holds reduced or other pictures may not be the one that is meant.
    let has_size_of_camera = |folder: &&PathBuf| {
        let mut files = names.iter().map(|name| folder.join(name));
        // The first that can be read: a pointer of Git LFS says nothing of its folder.
        let header = files.find_map(|file| kind_by_header(&file));
        sought.sizes.is_empty() || header.is_some_and(|(size, _)| sought.sizes.contains(&size))
    };
    let first = usual.iter().find(holds_one);
    if let Some(folder) = first.filter(holds_most).filter(has_size_of_camera) {
        return Some(ImageFolder::new(folder));
    }
    let searched = searched(root, model, &usual, sought);
    let found = searched
        .or_else(|| first.map(ImageFolder::new))
        .or_else(|| {
            // The project and the folders of the model always exist: images need not belong there.
            let is_own = |folder: &Path| folder == root || model.starts_with(folder);
            let own = usual.iter().find(|folder| !is_own(folder));
            own.map(ImageFolder::new)
        })?;
    Some(ImageFolder {
        is_searched: !usual.contains(&found.path),
        ..found
    })
}

/// The folder that holds most of the names, of the usual places and those below the project, else
/// of the reduced copies; one above it in the project if more of the images are in other folders
/// there.
fn searched(
    root: &Path,
    model: &Path,
    usual: &[PathBuf],
    sought: &SoughtImages,
) -> Option<ImageFolder> {
    let names = &sought.names;
    if names.is_empty() {
        return None;
    }
    let search = Names::new();
    let folders = [usual, &folders_below(root)].concat();
    let best = holding_most(&folders, sought, &search)
        .or_else(|| holding_most(&reduced(root, model), sought, &search))?;
    let mut widest = (held_below(&best, names), best.path.clone());
    // One photograph that a folder lacks is not that of another flight: cameras begin to count
    // anew.
    if sought.are_most(widest.0) {
        return Some(best);
    }
    let above = best.path.ancestors().skip(1);
    for folder in above.take_while(|folder| folder.starts_with(root)) {
        let held = held_below(folder, names);
        if held > widest.0 {
            widest = (held, folder.into());
        }
    }
    Some(if widest.1 == best.path {
        best
    } else {
        ImageFolder::new(widest.1)
    })
}

/// Number of the names of which a folder has the file, in whatever folder below it.
fn held_below(folder: &Path, names: &[String]) -> usize {
    let (there, missing): (Vec<&str>, Vec<&str>) = names
        .iter()
        .map(String::as_str)
        .partition(|name| folder.join(name).is_file());
    let missing: Vec<(&str, &str)> = missing.into_iter().map(|name| (name, name)).collect();
    there.len() + others(folder, &missing, &there).found.len()
}

/// Returns whether a folder holds any of the names, in any spelling.
pub(super) fn holds_any(folder: &Path, names: &[String]) -> bool {
    Held::new(folder, names, &Names::new()) > Held::default()
}

/// Of the folders that hold most of the names, the one that looks best, and the first of these;
/// `None` if none holds any.
fn holding_most(folders: &[PathBuf], sought: &SoughtImages, search: &Names) -> Option<ImageFolder> {
    let mut best: (Held, Vec<&PathBuf>) = Default::default();
    for folder in folders {
        let held = Held::new(folder, &sought.names, search);
        // A folder that holds nothing equals the initial value, and is no rival.
        if held > best.0 {
            best = (held, vec![folder]);
        } else if held == best.0 && !best.1.is_empty() && !best.1.contains(&folder) {
            best.1.push(folder);
        }
    }
    let rivals = match best.1[..] {
        [] => return None,
        [only] => return Some(ImageFolder::new(only)),
        _ => best.1,
    };
    let looks = Look::of_all(&rivals, sought, search);
    let mut by_look: Vec<(Look, &PathBuf)> = looks.into_iter().zip(rivals).collect();
    // A stable sort: of folders that look alike, the first found stays first.
    by_look.sort_by_key(|(look, _)| Reverse(*look));
    let (best, folder) = by_look[0];
    let others = by_look[1..].iter();
    let rivals = others.filter(|(look, _)| look.may_be_meant() == best.may_be_meant());
    Some(ImageFolder {
        rivals: rivals.map(|(_, folder)| folder.to_path_buf()).collect(),
        ..ImageFolder::new(folder)
    })
}

/// How much an image in a folder looks like the photograph that a name means, rather than a reduced
/// copy, its mask, its depths or another result, in order of significance.
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord)]
struct Look {
    has_size_of_camera: bool,
    is_named_as_source: bool,
    is_coloured: bool,
    pixels: u64,
}

impl Look {
    /// Looks at the first image that can be read in all folders; without one only names tell.
    fn of_all(folders: &[&PathBuf], sought: &SoughtImages, search: &Names) -> Vec<Self> {
        let header = |folder: &PathBuf, name: &str| {
            kind_by_header(&folder.join(search.locate(folder, name)?))
        };
        let of_name = |name: &String| -> Option<Vec<([u32; 2], bool)>> {
            folders.iter().map(|folder| header(folder, name)).collect()
        };
        let headers = sought.names.iter().find_map(of_name);
        let headers = headers.unwrap_or_else(|| vec![Default::default(); folders.len()]);
        let look = |(folder, (size, is_coloured)): (&&PathBuf, ([u32; 2], bool))| Self {
            has_size_of_camera: sought.sizes.contains(&size),
            is_named_as_source: !is_named_as_result(folder),
            is_coloured,
            pixels: u64::from(size[0]) * u64::from(size[1]),
        };
        folders.iter().zip(headers).map(look).collect()
    }

    /// What must be the same of two folders for either to be meant: photographs may be grey.
    fn may_be_meant(self) -> (bool, bool) {
        (self.has_size_of_camera, self.is_named_as_source)
    }
}

/// Returns whether the first word of a folder's name is that of results.
fn is_named_as_result(folder: &Path) -> bool {
    let name = last(folder.to_str().unwrap_or_default()).to_lowercase();
    let mut words = name.split(|c: char| !c.is_alphabetic());
    words.next().is_some_and(|word| RESULTS.contains(&word))
}

/// The folders below the project that may hold its images, itself first.
fn folders_below(root: &Path) -> Vec<PathBuf> {
    // A link may lead out of the project, or back to a folder above it.
    let entries = WalkDir::new(root)
        .max_depth(DEPTH)
        .follow_links(false)
        .sort_by_file_name()
        .into_iter();
    let entries = entries
        .filter_entry(|entry| entry.depth() == 0 || !is_skipped(entry))
        .take(MOST_ENTRIES)
        .filter_map(Result::ok);
    entries
        .filter(|entry| entry.file_type().is_dir())
        .map(DirEntry::into_path)
        .take(MOST_FOLDERS)
        .collect()
}

/// Number of names of which a folder holds the file, in order of significance.
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord)]
struct Held {
    in_any_spelling: usize,
    exactly: usize,
    /// Without the folders in the name.
    by_last_part: usize,
}

impl Held {
    fn new(folder: &Path, names: &[String], search: &Names) -> Self {
        let count =
            |holds: &dyn Fn(&String) -> bool| names.iter().filter(|name| holds(name)).count();
        Self {
            in_any_spelling: count(&|name| search.locate(folder, name).is_some()),
            exactly: count(&|name| folder.join(name).is_file()),
            by_last_part: count(&|name| search.locate(folder, last(name)).is_some()),
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::{super::image_files::slashes, *};

    pub fn folder_with(files: &[&str]) -> tempfile::TempDir {
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
        let sought = SoughtImages {
            names,
            sizes: HashSet::new(),
        };
        let found = find(root, &root.join("sparse/0"), None, &sought)?;
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
            Some(("".into(), false)),
            "in two folders"
        );
        assert_eq!(
            found(&["photos/a.jpg", "photos/b.jpg"], &two),
            Some(("photos".into(), true))
        );
        assert_eq!(
            found(&["images/flight 1/a.jpg"], &two),
            Some(("images/flight 1".into(), true))
        );
        let three = ["/home/x/1/a.jpg", "/home/x/1/b.jpg", "/home/x/2/c.jpg"];
        assert_eq!(
            found(
                &["images/1/a.jpg", "images/1/b.jpg", "images/2/c.jpg"],
                &three
            ),
            Some(("images".into(), false))
        );
        assert_eq!(
            found(
                &["images/a.png", "images/b.png", "images/thumbs/a.jpg"],
                &two
            ),
            Some(("images".into(), false))
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
            ".trash/a.jpg",
        ];
        assert_eq!(found(&results, &two), None);
        let reduced = ["images_4/a.png", "images_2/a.png", "viewrank/images/a.jpg"];
        assert_eq!(found(&reduced, &two), Some(("images_2".into(), true)));
    }

    #[test]
    fn a_folder_of_folders_is_told_from_those_below() {
        let names = ["seq1/0.jpg", "seq2/0.jpg", "seq1/1.jpg"];
        let files = ["seq1/0.png", "seq2/0.png", "seq1/1.png"];
        let below = files.map(|file| format!("photos/{file}"));
        assert_eq!(found(&files, &names), Some(("".into(), false)));
        assert_eq!(
            found(&below.each_ref().map(String::as_str), &names),
            Some(("photos".into(), true))
        );
    }
}
