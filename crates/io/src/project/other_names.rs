//! Finds the files of images that are not in the image folder under their names.

use std::{
    collections::{BTreeMap, HashMap, hash_map::Entry},
    path::Path,
};

use walkdir::WalkDir;

use super::{
    folder::is_skipped,
    image_files::{MOST_ENTRIES, is_image, slashes},
    names::{Names, folded, last},
};
use crate::{formats::name_parts, paths::stem};

/// Images of a model that are not in the folder under their names.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Others {
    /// Paths relative to the folder, by name in the model.
    pub found: BTreeMap<String, String>,
    /// Two files that fit a name alike, by name in the model.
    pub ambiguous: BTreeMap<String, [String; 2]>,
}

/// Looks in a folder for images that are `missing` under their names, each with the path that the
/// model gives. `taken`: names of the other images.
pub(super) fn others(folder: &Path, missing: &[(&str, &str)], taken: &[&str]) -> Others {
    let names = Names::new();
    let mut found: BTreeMap<&str, String> = BTreeMap::new();
    let mut ambiguous = BTreeMap::new();
    for (name, path) in missing {
        found.extend(names.locate(folder, path).map(|file| (*name, file)));
    }
    // `./a.jpg` is there as a.jpg.
    let is_there = |name: &str, file: &str| {
        name_parts(file).is_some_and(|parts| parts.join("/") == name) && folder.join(name).is_file()
    };
    let moved = missing.iter().map(|(name, _)| *name);
    let moved: Vec<&str> = moved.filter(|name| !found.contains_key(name)).collect();
    found.retain(|name, file| !is_there(name, file));
    for (name, files) in in_other_folders(folder, &moved) {
        match files {
            Fitting::One(file) => drop(found.insert(name, file)),
            Fitting::Several(two) => drop(ambiguous.insert(name.to_owned(), two)),
        }
    }
    Others {
        found: of_one_image(found, taken),
        ambiguous,
    }
}

/// The files that are neither those of two images nor taken, by name of their image.
fn of_one_image(found: BTreeMap<&str, String>, taken: &[&str]) -> BTreeMap<String, String> {
    let mut uses: HashMap<String, usize> = HashMap::new();
    let files = found.values().map(String::as_str);
    for file in files.chain(taken.iter().copied()) {
        *uses.entry(file.to_owned()).or_default() += 1;
    }
    let found = found.into_iter().filter(|(_, file)| uses[file] == 1);
    found.map(|(name, file)| (name.to_owned(), file)).collect()
}

/// Files that fit the name of an image.
#[derive(Clone)]
enum Fitting {
    One(String),
    /// The first two.
    Several([String; 2]),
}

impl Fitting {
    fn add(&mut self, file: String) {
        if let Self::One(first) = self {
            *self = Self::Several([std::mem::take(first), file]);
        }
    }
}

/// Images with a file of their name in any sub-folder. Images of one name in several folders of the
/// model are told apart by their folders alone.
fn in_other_folders<'a>(folder: &Path, missing: &[&'a str]) -> BTreeMap<&'a str, Fitting> {
    if missing.is_empty() {
        return BTreeMap::new();
    }
    let mut wanted: HashMap<String, Vec<&str>> = HashMap::new();
    for name in missing {
        wanted.entry(file_key(name)).or_default().push(*name);
    }
    let files = files_below(folder);
    let only = |(key, names): (String, Vec<&'a str>)| match names[..] {
        [name] => Some((name, files.get(&key)?.clone())),
        _ => None,
    };
    wanted.into_iter().filter_map(only).collect()
}

/// The name of an image's file without its extension, as far as spellings may differ.
fn file_key(name: &str) -> String {
    folded(stem(last(name)))
}

/// The images in a folder and below it, by [`file_key`].
fn files_below(folder: &Path) -> HashMap<String, Fitting> {
    let mut files: HashMap<String, Fitting> = HashMap::new();
    let entries = WalkDir::new(folder)
        // Images are often elsewhere, behind a link.
        .follow_links(true)
        // Sorted, since the first two of several files are named in messages.
        .sort_by_file_name()
        .into_iter()
        .filter_entry(|entry| entry.depth() == 0 || !is_skipped(entry))
        .take(MOST_ENTRIES)
        // A link that leads back to a folder above is an error, behind which the walk goes on.
        .filter_map(Result::ok);
    for entry in entries.filter(|entry| entry.file_type().is_file() && is_image(entry.path())) {
        let Ok(path) = entry.path().strip_prefix(folder) else {
            continue;
        };
        let path = slashes(path);
        match files.entry(file_key(&path)) {
            Entry::Vacant(none) => drop(none.insert(Fitting::One(path))),
            Entry::Occupied(mut held) => held.get_mut().add(path),
        }
    }
    files
}

#[cfg(test)]
mod tests {
    use super::{super::folder::tests::folder_with, *};

    #[test]
    fn no_file_is_that_of_two_images() {
        let folder = folder_with(&["a.jpg", "b.png"]);
        let found = |missing: &[&str], taken: &[&str]| {
            let missing: Vec<_> = missing.iter().map(|name| (*name, *name)).collect();
            others(folder.path(), &missing, taken).found
        };
        assert_eq!(found(&["A.jpg"], &["a.jpg"]), BTreeMap::new());
        assert_eq!(found(&["b.jpg", "b.tif"], &[]), BTreeMap::new());
        assert_eq!(found(&["b.jpg"], &["a.jpg"]).len(), 1);
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
        let others = others(folder.path(), &names.map(|name| (name, name)), &[]);
        let two = ["x/c.jpg", "y/c.jpg"].map(str::to_owned);
        assert_eq!(
            others.ambiguous,
            BTreeMap::from([("c.jpg".to_owned(), two)])
        );
        let others: Vec<_> = others
            .found
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
