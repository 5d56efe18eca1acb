//! Finds the files that a model names, as another system may have spelled them: with separators of
//! Windows, in other case, in another Unicode form, with another extension of images.

use std::{
    cell::{Cell, RefCell},
    collections::HashMap,
    path::{Path, PathBuf},
    rc::Rc,
};

use unicode_normalization::UnicodeNormalization;

use super::{
    image_files::{MOST_ENTRIES, is_image, slashes},
    images::ImageSearch,
};
use crate::{
    formats::{
        SEPARATORS,
        colmap::ColmapModel,
        foreign::{is_of_windows, last_parts},
        name_parts,
    },
    paths::{self, stem},
};

/// Names of the folder of images of which programs make reduced copies.
const REDUCED: [&str; 3] = ["images", "image", "input"];
/// Factors of reduced copies.
const FACTORS: [u32; 4] = [2, 4, 8, 16];

/// Looks up names in folders, and keeps their listings.
pub(super) struct Names {
    listings: RefCell<HashMap<PathBuf, Rc<Listing>>>,
    left: Cell<usize>,
}

/// The folders and images in a folder, by folded names.
#[derive(Default)]
struct Listing {
    folders: HashMap<String, Vec<String>>,
    images: HashMap<String, Only>,
    /// By name without extension.
    stems: HashMap<String, Only>,
    /// Folders with reduced copies of the folder of images of a name, each with its factor, the
    /// largest first.
    reduced: HashMap<String, Vec<(u32, String)>>,
}

/// The file that has a name, unless several have it.
enum Only {
    One(String),
    Several,
}

impl Only {
    fn add(map: &mut HashMap<String, Self>, key: String, name: &str) {
        map.entry(key)
            .and_modify(|only| *only = Self::Several)
            .or_insert_with(|| Self::One(name.to_owned()));
    }
}

impl Names {
    pub fn new() -> Self {
        Self {
            listings: RefCell::default(),
            left: Cell::new(MOST_ENTRIES),
        }
    }

    /// Path relative to `folder` of the file that is meant by a name: the file of this very name,
    /// else the only one that fits.
    pub fn locate(&self, folder: &Path, name: &str) -> Option<String> {
        // Before any file is looked up: the name may lead out of the folder.
        let parts = name_parts(below_drive(name))?;
        if folder.join(name).is_file() {
            return Some(name.to_owned());
        }
        let (file, folders) = parts.split_last()?;
        let (mut at, mut path) = (folder.to_path_buf(), String::new());
        for part in folders {
            let there = match *part {
                // The one that `name_parts` admits, at the start of a name.
                ".." => Some((*part).to_owned()),
                part => self.folder_in(&at, part),
            }?;
            at.push(&there);
            path += &there;
            path.push('/');
        }
        let file = if at.join(file).is_file() {
            (*file).to_owned()
        } else {
            self.listing(&at).only_image(file)?
        };
        Some(path + &file)
    }

    /// Name of the folder in `parent` that is meant by a name: this very one, else the only one
    /// that differs in case or Unicode form, else the largest of reduced copies (`images_2`).
    pub fn folder_in(&self, parent: &Path, name: &str) -> Option<String> {
        if parent.join(name).is_dir() {
            return Some(name.to_owned());
        }
        let listing = self.listing(parent);
        match listing.folders.get(&folded(name)).map(Vec::as_slice) {
            Some([only]) => Some(only.clone()),
            Some(_) => None,
            None => self.reduced_in(parent, name).into_iter().next(),
        }
    }

    /// Names of the folders in `parent` with reduced copies of the folder of images (`images_2`,
    /// `images_4`), the largest first; none of another folder: `flight_2` is another flight.
    pub fn reduced_in(&self, parent: &Path, name: &str) -> Vec<String> {
        let own = folded(name);
        if !REDUCED.contains(&&*own) {
            return Vec::new();
        }
        let listing = self.listing(parent);
        let reduced = listing.reduced.get(&own).into_iter().flatten();
        reduced.map(|(_, name)| name.clone()).collect()
    }

    fn listing(&self, folder: &Path) -> Rc<Listing> {
        if let Some(known) = self.listings.borrow().get(folder) {
            return known.clone();
        }
        let mut listing = Listing::default();
        let entries = std::fs::read_dir(folder).into_iter().flatten();
        for entry in entries.filter_map(Result::ok).take(self.left.get()) {
            // One budget for all folders: a model may name any number of them.
            self.left.set(self.left.get() - 1);
            if let Ok(name) = entry.file_name().into_string() {
                listing.add(name, &entry.path());
            }
        }
        listing.find_reduced();
        // Counted references, so that other folders can be listed while one is in use.
        let listing = Rc::new(listing);
        self.listings
            .borrow_mut()
            .insert(folder.to_path_buf(), listing.clone());
        listing
    }
}

/// Names the images of a model made on another machine as their files are named here: with
/// separators of Windows, or with an absolute path of which only the end still holds. Each name
/// becomes a path below a folder, without `.`, `..` and empty parts, since exports put links and
/// depth maps in its place.
///
/// Returns the path of the file, if it is another, by name.
pub(super) fn take_names_of_files(
    model: &mut ColmapModel,
    images: Option<&Path>,
) -> HashMap<String, String> {
    let mut names: Vec<String> = model.images.iter().map(|i| i.name.to_string()).collect();
    let spelled = to_names_of_files(&mut names, images);
    for (image, name) in model.images.iter_mut().zip(names) {
        if image.name != name {
            image.name = name.into();
        }
    }
    spelled
}

/// Changes the names of a model's images as [`take_names_of_files`] does.
pub(super) fn to_names_of_files(
    names: &mut [String],
    images: Option<&Path>,
) -> HashMap<String, String> {
    if let Some(images) = images {
        let search = ImageSearch::new(vec![images.to_path_buf()]);
        rename(names, |name| {
            // A file of this very name is meant, even with a backslash in it.
            if images.join(name).is_file() {
                from_folder(name, images)
            } else {
                name_here(name, images, &search)
            }
        });
    }
    rename(names, plain)
}

/// Gives images other names, unless two images would have one: they would be taken for each other.
/// Returns the names before that, by those after.
fn rename(names: &mut [String], other: impl Fn(&str) -> Option<String>) -> HashMap<String, String> {
    let others: Vec<Option<String>> = names.iter().map(|name| other(name)).collect();
    let mut images_of: HashMap<String, usize> = HashMap::new();
    for (name, other) in names.iter().zip(&others) {
        let name = other.as_ref().unwrap_or(name);
        *images_of.entry(name.clone()).or_default() += 1;
    }
    let mut before = HashMap::new();
    for (name, other) in names.iter_mut().zip(others) {
        if let Some(other) = other.filter(|other| other != name && images_of[other] == 1) {
            before.insert(other.clone(), std::mem::replace(name, other));
        }
    }
    before
}

/// The path in the folder of images of a file there that a model names by its whole path.
fn from_folder(name: &str, images: &Path) -> Option<String> {
    let file = Path::new(name).is_absolute().then_some(name)?;
    let file = paths::place_of_file(Path::new(file));
    let inside = file.strip_prefix(paths::real(images)).ok()?;
    inside.to_str().map(|_| slashes(inside))
}

/// Two images whose names lead to one file.
pub(super) fn with_one_file(model: &ColmapModel, images: Option<&Path>) -> Option<[String; 2]> {
    // Resolving a path takes system calls, so only images with the same plain name are compared.
    let file = |name: &str| match images {
        Some(images) => paths::place_of_file(&images.join(name)),
        None => PathBuf::from(name_parts(name).unwrap_or_default().join("/")),
    };
    let mut known: HashMap<String, &str> = HashMap::new();
    for image in &model.images {
        let name: &str = &image.name;
        let inside = images.and_then(|images| from_folder(name, images));
        let of_plain = inside
            .or_else(|| plain(name))
            .unwrap_or_else(|| name.into());
        match known.insert(of_plain, name) {
            Some(other) if file(other) == file(name) => {
                return Some([other, name].map(str::to_owned));
            }
            _ => {}
        }
    }
    None
}

/// The name under which the folder of images has the file, which isn't the image's own.
fn name_here(name: &str, images: &Path, search: &ImageSearch) -> Option<String> {
    let has_file = |name: &str| images.join(name).is_file();
    let is_inside = |moved: &str| name_parts(moved).is_some_and(|parts| !parts.contains(&".."));
    let separated = [name, below_drive(name)].map(|name| name.replace('\\', "/"));
    let ends = || last_parts(name).into_iter().skip(1);
    let mut moved = separated.into_iter().chain(ends());
    moved
        .find(|moved| moved != name && is_inside(moved) && has_file(moved))
        .or_else(|| ends().find(|end| is_inside(end) && search.finds(end)))
}

/// The name that an image gets, as [`take_names_of_files`] gives it where the file has no other.
pub(super) fn plain_or_own(name: String) -> String {
    plain(&name).unwrap_or(name)
}

/// A name as a path below a folder: with slashes, without a drive and the parts that lead to the
/// same folder or above; `None` if it leads further out than to the parent of its folder.
fn plain(name: &str) -> Option<String> {
    let parts = name_parts(below_drive(name))?;
    let parts: Vec<&str> = parts.into_iter().filter(|part| *part != "..").collect();
    (!parts.is_empty()).then(|| parts.join("/"))
}

/// A name without its drive, which may stand before a path relative to the drive's current folder,
/// too (`C:a.jpg`), or without the slashes before a server.
fn below_drive(name: &str) -> &str {
    let has_drive = matches!(name.as_bytes(), [drive, b':', ..] if drive.is_ascii_alphabetic());
    let below = name.get(2..).filter(|_| has_drive || is_of_windows(name));
    below.unwrap_or(name)
}

impl Listing {
    fn add(&mut self, name: String, path: &Path) {
        if path.is_dir() {
            self.folders.entry(folded(&name)).or_default().push(name);
        } else if is_image(path) {
            Only::add(&mut self.images, folded(&name), &name);
            Only::add(&mut self.stems, folded(stem(&name)), &name);
        }
    }

    /// The only image that fits a name, which may lack an extension or have that of another format;
    /// of several, the only one with the extension of the name. Of any number of images it takes
    /// the same time.
    fn only_image(&self, name: &str) -> Option<String> {
        let whole = folded(name);
        // `a.v2` may be a whole name without its extension, which comes before `a` with another
        // one.
        let by_stem = || [&whole, &folded(stem(name))].map(|stem| self.stems.get(stem));
        match self.images.get(&whole) {
            Some(Only::One(file)) => Some(file.clone()),
            // Of two that differ in case alone, neither is the one that is meant.
            Some(Only::Several) => None,
            None => match by_stem().into_iter().flatten().next()? {
                Only::One(file) => Some(file.clone()),
                Only::Several => None,
            },
        }
    }

    /// Notes the reduced copies, when all folders are known.
    fn find_reduced(&mut self) {
        for (folded, names) in &mut self.folders {
            // Directories are listed in any order, on which the choice must not depend.
            names.sort_unstable();
            let Some((own, factor)) = folded.rsplit_once('_') else {
                continue;
            };
            let factor = factor.parse().ok().filter(|n| FACTORS.contains(n));
            if let Some(factor) = factor.filter(|_| REDUCED.contains(&own)) {
                let copy = (factor, names[0].clone());
                self.reduced.entry(own.to_owned()).or_default().push(copy);
            }
        }
        self.reduced
            .values_mut()
            .for_each(|all| all.sort_unstable());
    }
}

/// The last part of a name.
pub(super) fn last(name: &str) -> &str {
    name.rsplit(SEPARATORS).next().unwrap_or(name)
}

/// A name in lower case and one Unicode form: macOS decomposes characters, others compose them.
pub(super) fn folded(name: &str) -> String {
    name.nfc().flat_map(char::to_lowercase).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn located(files: &[&str], name: &str) -> Option<String> {
        let folder = tempfile::tempdir().unwrap();
        let at = folder.path().join("project");
        for file in files {
            let path = at.join(file);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, "image").unwrap();
        }
        Names::new().locate(&at, name)
    }

    fn assert_located(files: &[&str], name: &str, file: &str) {
        assert_eq!(located(files, name).as_deref(), Some(file), "{name}");
    }

    #[test]
    fn a_name_finds_the_only_file_that_fits() {
        assert_located(&["cam1/a.jpg", "cam2/a.jpg"], "cam2/a.jpg", "cam2/a.jpg");
        assert_located(&["Cam1/A.JPG", "cam2/a.jpg"], r"cam1\a.jpg", "Cam1/A.JPG");
        assert_located(&["cam1/a.png"], "./cam0/../cam1/a.jpg", "cam1/a.png");
        assert_located(&["a.v2.jpg", "a.png"], "a.v2", "a.v2.jpg");
        assert_located(&["a.jpg", "a.png"], "A.png", "a.png");
        assert_located(&["a.jpg.png", "a.jpg.tif", "A.jpg"], "a.JPG", "A.jpg");
        assert_located(
            &["../other/a.jpg", "b.jpg"],
            "../other/A.jpg",
            "../other/a.jpg",
        );
        assert_located(
            &["images_8/a.jpg", "images_2/a.png"],
            "images/a.jpg",
            "images_2/a.png",
        );
        // e and an acute accent, as macOS writes them, for one character.
        assert_located(
            &["e\u{301}t\u{e9}/e\u{301}.jpg"],
            "\u{e9}te\u{301}/\u{c9}.JPG",
            "e\u{301}t\u{e9}/e\u{301}.jpg",
        );
    }

    #[test]
    fn of_reduced_copies_the_largest_is_first() {
        let folder = tempfile::tempdir().unwrap();
        for name in [
            "images_16",
            "Images_4",
            "images_8",
            "images_3",
            "image_2",
            "images_x",
        ] {
            std::fs::create_dir(folder.path().join(name)).unwrap();
        }
        let names = Names::new();
        let reduced = ["Images_4", "images_8", "images_16"];
        assert_eq!(names.reduced_in(folder.path(), "images"), reduced);
        assert_eq!(names.reduced_in(folder.path(), "IMAGE"), ["image_2"]);
        assert!(names.reduced_in(folder.path(), "photos").is_empty());
    }

    #[test]
    fn another_flight_is_no_reduced_copy() {
        let flights = ["flight_1/a.jpg", "flight_2/a.jpg", "images_3/a.jpg"];
        assert_eq!(located(&flights, "flight/a.jpg"), None);
        assert_eq!(located(&flights, "images/a.jpg"), None);
    }

    #[test]
    fn a_name_that_fits_several_files_or_leads_away_finds_none() {
        assert_eq!(located(&["a.png", "a.tif"], "a.jpg"), None);
        assert_eq!(located(&["A.jpg", "a.JPG"], "a.Jpg"), None);
        assert_eq!(located(&["._a.jpg", ".a.jpg"], "a.jpg"), None);
        assert_eq!(located(&["b.jpg"], "a.jpg"), None);
        let outside = ["../../../etc/a.jpg", r"..\..\a.jpg", "b/../../../a.jpg"];
        for name in outside {
            assert_eq!(
                located(&["../../etc/a.jpg", "../../a.jpg"], name),
                None,
                "{name}"
            );
        }
    }
}
