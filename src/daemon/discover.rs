//! Finds the projects under a root, at any depth, and what of each is its input.
//!
//! A folder is a project when it looks like one from outside: a COLMAP project or dense workspace (`sparse/`, with model files in it
//! or one level below), an OpenMVS scene, a SURE project. Whether the model is whole is not asked here. A project's own folders are
//! not searched for further projects.

use std::{
    fs, io,
    path::{Path, PathBuf},
};

use crate::confidence::MASKS;

/// Names of the files of a COLMAP model, without their suffix.
const MODEL_FILES: [&str; 5] = ["cameras", "images", "points3D", "rigs", "frames"];
/// Where the outputs of a project and the daemon's own files of a root go; never looked at as input.
pub const OUTPUT_FOLDER: &str = "viewrank";
/// Deeper than this is a loop of mounts or links.
const MAX_DEPTH: usize = 64;

/// What a walk over a root found.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Found {
    /// Project folders, sorted.
    pub projects: Vec<PathBuf>,
    /// Folders outside projects in which a project may appear, the root first.
    pub folders: Vec<PathBuf>,
    /// Folders that could not be listed, with the reason.
    pub unreadable: Vec<(PathBuf, String)>,
}

/// Walks the root. Symbolic links are followed only where `follow_links` says so.
pub fn walk(root: &Path, follow_links: bool) -> Found {
    let mut found = Found::default();
    let mut open = vec![(root.to_path_buf(), 0)];
    while let Some((folder, depth)) = open.pop() {
        let listing = match Listing::of(&folder, follow_links) {
            Ok(listing) => listing,
            Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
            Err(error) => {
                found.unreadable.push((folder, error.to_string()));
                continue;
            }
        };
        if listing.is_project(&folder) {
            found.projects.push(folder);
            continue;
        }
        if depth < MAX_DEPTH {
            let below = listing.folders.iter().filter(|name| !name.starts_with('.') && *name != OUTPUT_FOLDER);
            open.extend(below.map(|name| (folder.join(name), depth + 1)));
        }
        found.folders.push(folder);
    }
    found.projects.sort();
    found.folders.sort();
    found
}

/// Is this folder a project, seen from outside?
pub fn is_project(folder: &Path, follow_links: bool) -> bool {
    Listing::of(folder, follow_links).is_ok_and(|listing| listing.is_project(folder))
}

/// Is it a SURE project?
pub fn holds_orientations(folder: &Path) -> bool {
    Listing::of(folder, true).is_ok_and(|listing| listing.holds_orientations(folder))
}

/// Names in a folder; those that are no UTF-8 are left out, since no model can name them.
struct Listing {
    files: Vec<String>,
    folders: Vec<String>,
}

impl Listing {
    fn of(folder: &Path, follow_links: bool) -> io::Result<Self> {
        let (mut files, mut folders) = (Vec::new(), Vec::new());
        for entry in fs::read_dir(folder)? {
            let entry = entry?;
            let Ok(name) = entry.file_name().into_string() else { continue };
            let Ok(mut kind) = entry.file_type() else { continue };
            if kind.is_symlink() {
                match fs::metadata(entry.path()) {
                    Ok(target) if follow_links || target.is_file() => kind = target.file_type(),
                    _ => continue,
                }
            }
            if kind.is_dir() { folders.push(name) } else { files.push(name) }
        }
        Ok(Self { files, folders })
    }

    fn is_project(&self, folder: &Path) -> bool {
        let has = |name: &str| self.folders.iter().any(|f| f == name);
        let scene = self.files.iter().any(|f| f.ends_with(".mvs"));
        has("sparse") || scene || self.holds_orientations(folder) || self.holds_model() && !is_sub_model(folder)
    }

    /// SURE's: here or in `ori`, which itself belongs to the project above.
    fn holds_orientations(&self, folder: &Path) -> bool {
        let here = || !folder.ends_with("ori") && self.files.iter().any(|f| f.ends_with(".ori"));
        self.files.iter().chain(&self.folders).any(|f| f == "ori") || here()
    }

    /// Any file of a COLMAP model: the folder is a bare model, perhaps half copied.
    fn holds_model(&self) -> bool {
        self.files.iter().any(|f| is_model_file(f))
    }
}

/// `sparse/0` belongs to the project above.
fn is_sub_model(folder: &Path) -> bool {
    let named = |path: &Path, name: &str| path.file_name().is_some_and(|n| n == name);
    named(folder, "sparse") || folder.parent().is_some_and(|above| named(above, "sparse"))
}

/// `cameras.bin`, `points3D.txt` and the like.
pub fn is_model_file(name: &str) -> bool {
    let stem = name.strip_suffix(".bin").or_else(|| name.strip_suffix(".txt"));
    stem.is_some_and(|stem| MODEL_FILES.contains(&stem))
}

/// The folders of a project whose contents are its input: the project folder, its models, images and masks. Symbolic links are
/// followed only where `follow_links` says so.
pub fn input_folders(project: &Path, follow_links: bool) -> Vec<PathBuf> {
    let mut folders = vec![project.to_path_buf()];
    for above in [project.to_path_buf(), project.join("dense")] {
        let sparse = above.join("sparse");
        folders.extend(sub_folders(&sparse));
        folders.push(sparse);
        folders.push(above.join("ori"));
    }
    folders.extend(image_folders(project));
    folders.extend(mask_folders(project));
    folders.retain(|folder| folder.is_dir() && may_enter(project, folder, follow_links));
    folders.sort();
    folders.dedup();
    folders
}

/// Does no symbolic link lead from the project to its folder, or may links be followed?
pub fn may_enter(project: &Path, folder: &Path, follow_links: bool) -> bool {
    follow_links || folder.ancestors().take_while(|above| *above != project).all(|above| !above.is_symlink())
}

/// `images/` and the folders below it; their entries, not their bytes, are input.
pub fn image_folders(project: &Path) -> Vec<PathBuf> {
    folders_at(&project.join("images"))
}

/// `masks/` and the folders below it.
pub fn mask_folders(project: &Path) -> Vec<PathBuf> {
    folders_at(&project.join(MASKS))
}

fn folders_at(top: &Path) -> Vec<PathBuf> {
    let walk = walkdir::WalkDir::new(top).max_depth(MAX_DEPTH).into_iter().filter_map(Result::ok);
    walk.filter(|entry| entry.file_type().is_dir()).map(walkdir::DirEntry::into_path).collect()
}

fn sub_folders(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok);
    entries.map(|entry| entry.path()).filter(|path| path.is_dir()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn touch(root: &Path, path: &str) {
        let path = root.join(path);
        fs::create_dir_all(path.parent().expect("below the root")).expect("a temporary folder");
        fs::write(path, "").expect("a temporary file");
    }

    #[test]
    fn projects_of_every_kind_are_found_at_any_depth_and_not_inside_each_other() {
        let root = tempfile::tempdir().expect("a temporary folder");
        for path in [
            "a/sparse/0/cameras.bin",
            "a/dense/sparse/cameras.bin",
            "b/c/d/e/sparse/points3D.txt",
            "bare model/images.bin",
            "mvs/scene.mvs",
            "sure/ori/x.ori",
            "sure without a folder/x.ori",
            "viewrank/sparse/0/cameras.bin",
            ".hidden/sparse/0/cameras.bin",
            "notes/readme.txt",
        ] {
            touch(root.path(), path);
        }
        let found = walk(root.path(), false);
        let names: Vec<_> = found.projects.iter().map(|p| p.strip_prefix(root.path()).expect("below")).collect();
        assert_eq!(names, ["a", "b/c/d/e", "bare model", "mvs", "sure", "sure without a folder"].map(Path::new));
        assert!(found.folders.contains(&root.path().join("notes")), "a project may appear there");
        assert!(found.unreadable.is_empty());
    }

    #[test]
    fn links_out_of_the_root_are_followed_only_when_asked() {
        let outside = tempfile::tempdir().expect("a temporary folder");
        touch(outside.path(), "p/sparse/0/cameras.bin");
        let root = tempfile::tempdir().expect("a temporary folder");
        std::os::unix::fs::symlink(outside.path(), root.path().join("link")).expect("a link");
        assert!(walk(root.path(), false).projects.is_empty());
        assert_eq!(walk(root.path(), true).projects, [root.path().join("link/p")]);
        touch(root.path(), "q/sparse/1/cameras.bin");
        std::os::unix::fs::symlink(outside.path().join("p/sparse/0"), root.path().join("q/sparse/0")).expect("a link");
        let project = root.path().join("q");
        let model = project.join("sparse/0");
        assert!(!input_folders(&project, false).contains(&model) && input_folders(&project, true).contains(&model));
        assert!(input_folders(&project, false).contains(&project.join("sparse/1")));
    }

    #[test]
    fn a_loop_of_links_ends() {
        let root = tempfile::tempdir().expect("a temporary folder");
        std::os::unix::fs::symlink(root.path(), root.path().join("again")).expect("a link");
        assert!(walk(root.path(), true).projects.is_empty());
    }
}
