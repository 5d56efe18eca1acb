//! Finds the projects under a root, at any depth, and their input folders.
//!
//! The names of its files make a folder a project: a COLMAP project or dense workspace (`sparse/`,
//! with model files in it or one level below), a bare model (at least two of its files), a model of
//! another program, in the places where `viewrank plan` looks. The model may be incomplete. Folders
//! inside a project are not searched for further projects. A folder that contains several projects,
//! or a root that contains one, is not a project, whatever stray files it has, unless it has a
//! `sparse` of its own.

use std::{
    collections::{BTreeSet, HashSet},
    ffi::{OsStr, OsString},
    fs, io,
    path::{Path, PathBuf},
};

use crate::{
    base::paths::sub_folders,
    io::project::{self, FOLDERS_OF_PROGRAMS, MASKS, WORKSPACES},
};

/// File names of a COLMAP model, without suffix.
const MODEL_FILES: [&str; 5] = ["cameras", "images", "points3D", "rigs", "frames"];
/// Folder for the outputs of a project and the daemon's own files of a root; never input.
pub const OUTPUT_FOLDER: &str = "viewrank";
/// Folders of a project's images.
const IMAGES: [&str; 2] = ["images", "input"];
/// This many projects in a folder with stray files of a model or scene are separate projects.
const SEVERAL: usize = 2;
/// Depth limit of a walk, against loops of mounts.
const MAX_DEPTH: usize = 64;

/// Result of a walk over a folder.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Discovery {
    /// Project folders, sorted.
    pub projects: Vec<PathBuf>,
    /// Folders outside projects in which a project may appear, the root first.
    pub folders: Vec<PathBuf>,
    /// Folders that could not be listed, with the error.
    pub unreadable: Vec<(PathBuf, String)>,
}

/// Walks a folder that is one of the `roots` or below. Symbolic links are followed only with
/// `follow_links`, after all other folders; no folder is entered twice. `tick` is called for every
/// folder.
pub fn walk(folder: &Path, roots: &[PathBuf], follow_links: bool, tick: &dyn Fn()) -> Discovery {
    let (found, links) = Default::default();
    let mut walk = Walk {
        roots,
        follow_links,
        tick,
        found,
        links,
        entered: HashSet::new(),
    };
    walk.enter(folder.to_path_buf(), 0);
    while let Some((link, depth)) = walk.links.pop() {
        walk.enter(link, depth);
    }
    walk.found.projects.sort();
    walk.found.folders.sort();
    walk.found
}

struct Walk<'a> {
    roots: &'a [PathBuf],
    follow_links: bool,
    tick: &'a dyn Fn(),
    found: Discovery,
    /// Links to folders, still to follow, with their depth.
    links: Vec<(PathBuf, usize)>,
    /// Canonical paths of all folders entered; used only where links are followed.
    entered: HashSet<PathBuf>,
}

impl Walk<'_> {
    fn enter(&mut self, folder: PathBuf, depth: usize) {
        (self.tick)();
        let listing = match Listing::read(&folder) {
            Ok(listing) => listing,
            // Removed since the folder above was listed.
            Err(error) if error.kind() == io::ErrorKind::NotFound => return,
            Err(error) => return self.found.unreadable.push((folder, error.to_string())),
        };
        // Only links lead to a folder twice, so canonical paths are not computed without them.
        if depth > MAX_DEPTH || self.follow_links && !self.is_new(&folder) {
            return;
        }
        let kind = listing.kind(&folder, self.follow_links);
        if kind == FolderKind::Project {
            return self.found.projects.push(folder);
        }
        let before = (self.found.lengths(), self.links.len());
        let (may_be_one, of_models) = match kind {
            FolderKind::MayBeProject { of_models } => (true, of_models),
            _ => (false, BTreeSet::new()),
        };
        // Its own workspaces and models would count as projects inside it.
        let (own, others): (Vec<_>, Vec<_>) = listing
            .below()
            .partition(|name| may_be_one && (is_workspace(name) || of_models.contains(*name)));
        others
            .into_iter()
            .for_each(|name| self.enter(folder.join(name), depth + 1));
        // Roots are meant to contain projects.
        let several = if self.roots.contains(&folder) {
            1
        } else {
            SEVERAL
        };
        if may_be_one && self.found.projects.len() < before.0[0] + several {
            // What was found below it is its own.
            self.found.truncate(before.0);
            self.links.truncate(before.1);
            return self.found.projects.push(folder);
        }
        own.into_iter()
            .for_each(|name| self.enter(folder.join(name), depth + 1));
        if self.follow_links {
            self.links.extend(
                listing
                    .links
                    .iter()
                    // Links are taken from the end: reversed, they are followed in the order of
                    // their names.
                    .rev()
                    .map(|name| (folder.join(name), depth + 1)),
            );
        }
        self.found.folders.push(folder);
    }

    fn is_new(&mut self, folder: &Path) -> bool {
        dunce::canonicalize(folder).is_ok_and(|folder| self.entered.insert(folder))
    }
}

impl Discovery {
    fn lengths(&self) -> [usize; 3] {
        [
            self.projects.len(),
            self.folders.len(),
            self.unreadable.len(),
        ]
    }

    fn truncate(&mut self, [projects, folders, unreadable]: [usize; 3]) {
        self.projects.truncate(projects);
        self.folders.truncate(folders);
        self.unreadable.truncate(unreadable);
    }
}

/// True if this is the name of a project's dense workspaces.
pub fn is_workspace(name: &OsStr) -> bool {
    WORKSPACES.iter().any(|workspace| name == *workspace)
}

/// True if projects are searched for in folders of this name.
pub fn is_searched(name: &OsStr) -> bool {
    !name.as_encoded_bytes().starts_with(b".") && name != OUTPUT_FOLDER
}

/// True if the names of its files make the folder a project, disregarding projects inside.
pub fn is_project(folder: &Path, follow_links: bool) -> bool {
    Listing::read(folder)
        .is_ok_and(|listing| listing.kind(folder, follow_links) != FolderKind::Folder)
}

/// Kind of a folder by the names of its files.
#[derive(Clone, Debug, PartialEq, Eq)]
enum FolderKind {
    Project,
    /// A project unless it contains several projects. `of_models`: names of the folders in it that
    /// hold models of other programs.
    MayBeProject {
        of_models: BTreeSet<OsString>,
    },
    Folder,
}

/// Sorted names in a folder.
#[derive(Debug, Default)]
struct Listing {
    files: BTreeSet<OsString>,
    folders: BTreeSet<OsString>,
    /// Links to folders.
    links: BTreeSet<OsString>,
}

impl Listing {
    fn read(folder: &Path) -> io::Result<Self> {
        let mut listing = Self::default();
        for entry in fs::read_dir(folder)? {
            let entry = entry?;
            let Ok(kind) = entry.file_type() else {
                continue;
            };
            let is_folder = || fs::metadata(entry.path()).is_ok_and(|target| target.is_dir());
            let names = match kind {
                kind if kind.is_dir() => &mut listing.folders,
                kind if kind.is_symlink() && is_folder() => &mut listing.links,
                _ => &mut listing.files,
            };
            names.insert(entry.file_name());
        }
        Ok(listing)
    }

    /// Folders to search for projects.
    fn below(&self) -> impl Iterator<Item = &OsString> {
        self.folders.iter().filter(|name| is_searched(name))
    }

    fn kind(&self, folder: &Path, follow_links: bool) -> FolderKind {
        let named = |names: &BTreeSet<OsString>, name: &str| names.contains(OsStr::new(name));
        let sparse = || holds_model_below(&folder.join("sparse"), follow_links);
        if named(&self.folders, "sparse") && sparse() {
            return FolderKind::Project;
        }
        // A link that may not be followed makes a project too, which waits and says why.
        if named(&self.links, "sparse") && (!follow_links || sparse()) {
            return FolderKind::Project;
        }
        let has_pictures = IMAGES.iter().any(|name| named(&self.folders, name));
        let of_program = |name: &&str| {
            let sparse = folder.join(name).join("sparse");
            named(&self.folders, name) && holds_model_below(&sparse, follow_links)
        };
        if has_pictures && FOLDERS_OF_PROGRAMS.iter().any(of_program) {
            return FolderKind::Project;
        }
        let scene = self
            .files
            .iter()
            // As bytes, since names need not be text.
            .any(|name| name.as_encoded_bytes().ends_with(b".mvs"));
        let bare_model = || self.model_files() >= 2 && !is_sub_model(folder);
        let of_others = models_of_others(folder, follow_links);
        if scene || self.holds_orientations(folder) || bare_model() || !of_others.is_empty() {
            let of_models = folders_of_models(folder, &of_others);
            FolderKind::MayBeProject { of_models }
        } else {
            FolderKind::Folder
        }
    }

    /// True if there are SURE orientations here or in `ori`, which itself belongs to the project
    /// above.
    fn holds_orientations(&self, folder: &Path) -> bool {
        let here = || {
            !folder.ends_with("ori")
                && self
                    .files
                    .iter()
                    .any(|f| f.as_encoded_bytes().ends_with(b".ori"))
        };
        [&self.files, &self.folders, &self.links]
            .iter()
            .any(|names| names.contains(OsStr::new("ori")))
            || here()
    }

    /// Number of COLMAP model files by stem, in any format.
    fn model_files(&self) -> usize {
        let stems = self
            .files
            .iter()
            .filter_map(|name| model_file(name.to_str()?));
        stems.collect::<BTreeSet<_>>().len()
    }
}

/// The models of other programs in a folder, behind no link unless links are followed.
fn models_of_others(folder: &Path, follow_links: bool) -> Vec<PathBuf> {
    let mut models = project::models_of_other_programs(folder);
    models.retain(|model| may_enter(folder, model, follow_links));
    models
}

/// Names of the folders in a project that hold these models of other programs.
fn folders_of_models(project: &Path, models: &[PathBuf]) -> BTreeSet<OsString> {
    let first = |model: &PathBuf| {
        let mut parts = model.strip_prefix(project).ok()?.components();
        let first = parts.next()?.as_os_str().to_owned();
        project.join(&first).is_dir().then_some(first)
    };
    models.iter().filter_map(first).collect()
}

/// True if `sparse` or a folder in it holds model files, or is unreadable and may hold some.
fn holds_model_below(sparse: &Path, follow_links: bool) -> bool {
    let holds_model = |listing: io::Result<Listing>| match listing {
        Ok(listing) => listing.model_files() > 0,
        Err(error) => error.kind() != io::ErrorKind::NotFound,
    };
    let Ok(listing) = Listing::read(sparse) else {
        return sparse.is_dir();
    };
    let in_folder = |name: &OsString| holds_model(Listing::read(&sparse.join(name)));
    listing.model_files() > 0
        || listing.folders.iter().any(in_folder)
        || listing
            .links
            .iter()
            .any(|name| !follow_links || in_folder(name))
}

/// True for `sparse` and its folders, which belong to the project above.
fn is_sub_model(folder: &Path) -> bool {
    let named = |path: &Path, name: &str| path.file_name().is_some_and(|n| n == name);
    named(folder, "sparse") || folder.parent().is_some_and(|above| named(above, "sparse"))
}

/// Returns the stem of a COLMAP model file such as `cameras.bin` or `points3D.txt`.
fn model_file(name: &str) -> Option<&str> {
    let stem = name
        .strip_suffix(".bin")
        .or_else(|| name.strip_suffix(".txt"));
    stem.filter(|stem| MODEL_FILES.contains(stem))
}

/// True for names of COLMAP model files, such as `cameras.bin` and `points3D.txt`.
pub fn is_model_file(name: &str) -> bool {
    model_file(name).is_some()
}

/// The folders of a project whose contents are its input.
#[derive(Clone, Debug, Default)]
pub struct InputFolders {
    /// The project folder and its models.
    pub models: Vec<PathBuf>,
    /// Model files of other programs than COLMAP.
    pub of_others: Vec<PathBuf>,
    /// `images/` and the folders below it, without masks.
    pub images: Vec<PathBuf>,
    /// `masks/`, `images/masks/` and the folders below them.
    pub masks: Vec<PathBuf>,
    /// The project is a SURE project.
    pub has_orientations: bool,
}

impl InputFolders {
    /// Lists the existing input folders. Symbolic links are followed only with `follow_links`.
    pub fn find(project: &Path, follow_links: bool) -> Self {
        let mut models = vec![project.to_path_buf()];
        for name in FOLDERS_OF_PROGRAMS.into_iter().chain(WORKSPACES) {
            let above = project.join(name);
            let sparse = above.join("sparse");
            models.extend(sub_folders(&sparse));
            models.push(sparse);
            models.push(above.join("ori"));
        }
        let mut of_others = models_of_others(project, follow_links);
        // An `Ori-` folder of MicMac is a model.
        let folders = of_others.extract_if(.., |model| model.is_dir());
        let oriented: Vec<PathBuf> = folders.collect();
        of_others.extend(oriented.iter().flat_map(|folder| orientations_in(folder)));
        models.extend(
            of_others
                .iter()
                .filter_map(|model| Some(model.parent()?.into())),
        );
        let has_orientations =
            Listing::read(project).is_ok_and(|listing| listing.holds_orientations(project));
        let mut images = IMAGES.map(|name| folders_at(&project.join(name))).concat();
        let mut masks = folders_at(&project.join(MASKS));
        let in_images = project.join("images").join(MASKS);
        masks.extend(images.extract_if(.., |folder| folder.starts_with(&in_images)));
        let mut folders = Self {
            models,
            of_others,
            images,
            masks,
            has_orientations,
        };
        for folders in [&mut folders.models, &mut folders.images, &mut folders.masks] {
            folders.retain(|folder| folder.is_dir() && may_enter(project, folder, follow_links));
            folders.sort();
            folders.dedup();
        }
        folders
    }

    /// All input folders.
    pub fn all(&self) -> impl Iterator<Item = &PathBuf> {
        self.models.iter().chain(&self.images).chain(&self.masks)
    }
}

/// True if links may be followed, or no symbolic link is on the way from the project to its file or
/// folder.
pub fn may_enter(project: &Path, path: &Path, follow_links: bool) -> bool {
    follow_links
        || path
            .ancestors()
            .take_while(|above| *above != project)
            .all(|above| !above.is_symlink())
}

/// The files of an `Ori-` folder of MicMac.
fn orientations_in(folder: &Path) -> Vec<PathBuf> {
    let listing = Listing::read(folder).unwrap_or_default();
    let is_one = |name: &&OsString| name.as_encoded_bytes().ends_with(b".xml");
    let names = listing.files.iter().filter(is_one);
    names.map(|name| folder.join(name)).collect()
}

fn folders_at(top: &Path) -> Vec<PathBuf> {
    let walk = walkdir::WalkDir::new(top)
        .max_depth(MAX_DEPTH)
        .into_iter()
        .filter_map(Result::ok);
    walk.filter(|entry| entry.file_type().is_dir())
        .map(walkdir::DirEntry::into_path)
        .collect()
}

#[cfg(test)]
mod tests {
    #[cfg(unix)]
    use std::os::unix::{ffi::OsStringExt, fs::symlink};

    use super::*;

    fn touch(root: &Path, path: &str) {
        let path = root.join(path);
        fs::create_dir_all(path.parent().expect("below the root")).expect("a temporary folder");
        fs::write(path, "").expect("a temporary file");
    }

    fn projects(root: &Path, follow_links: bool) -> Vec<String> {
        let found = walk(root, &[], follow_links, &|| {}).projects;
        found
            .iter()
            .map(|p| {
                p.strip_prefix(root)
                    .expect("below")
                    .to_string_lossy()
                    .into_owned()
            })
            .collect()
    }

    #[test]
    fn projects_of_every_kind_are_found_at_any_depth_but_not_inside_each_other() {
        let root = tempfile::tempdir().expect("a temporary folder");
        for path in [
            "a/sparse/0/cameras.bin",
            "a/dense/sparse/cameras.bin",
            "b/c/d/e/sparse/points3D.txt",
            "bare model/images.bin",
            "bare model/cameras.bin",
            "gs/input/a.jpg",
            "gs/distorted/sparse/0/cameras.bin",
            "models/colmap/sparse/0/cameras.bin",
            "ns/images/a.jpg",
            "ns/colmap/sparse/0/cameras.bin",
            "mvs/scene.mvs",
            "mvs/dense/sparse/cameras.bin",
            "mvs/undistorted/0/sparse/cameras.bin",
            "mvs/colmap/sparse/cameras.bin",
            "sure/ori/x.ori",
            "sure without a folder/x.ori",
            "viewrank/sparse/0/cameras.bin",
            ".hidden/sparse/0/cameras.bin",
            "notes/readme.txt",
            "notes/images.txt",
        ] {
            touch(root.path(), path);
        }
        fs::create_dir_all(root.path().join("empty/sparse/0")).expect("a folder");
        let found = walk(root.path(), &[], false, &|| {});
        let expected = [
            "a",
            "b/c/d/e",
            "bare model",
            "gs",
            "models/colmap",
            "mvs",
            "ns",
            "sure",
            "sure without a folder",
        ];
        assert_eq!(projects(root.path(), false), expected);
        for folder in ["notes", "empty/sparse/0"] {
            assert!(
                found.folders.contains(&root.path().join(folder)),
                "a project may appear in {folder}"
            );
        }
        assert!(found.unreadable.is_empty());
    }

    #[test]
    fn models_of_all_programs_make_projects() {
        let root = tempfile::tempdir().expect("a temporary folder");
        let write = |path: &str, text: &str| {
            touch(root.path(), path);
            fs::write(root.path().join(path), text).expect("a temporary file");
        };
        for path in [
            "odm/opensfm/reconstruction.json",
            "meshroom/MeshroomCache/StructureFromMotion/0a1b/cameras.sfm",
            "micmac/Ori-All/Orientation-a.jpg.xml",
            "mve/synth_0.out",
            "nerf/transforms.json",
            "mvg/sfm_data.json",
            "vsfm/a.nvm",
            "queue/nohup.out",
            "other/a.xml",
        ] {
            touch(root.path(), path);
        }
        write("bundler/bundle/bundle.out", "# Bundle file v0.3\n");
        write("metashape/cameras.xml", "<document><chunk/></document>");
        write("blocks/blocks.xml", "<BlocksExchange version=\"3.2\">");
        let expected = [
            "blocks",
            "bundler",
            "meshroom",
            "metashape",
            "micmac",
            "mve",
            "mvg",
            "nerf",
            "odm",
            "vsfm",
        ];
        assert_eq!(projects(root.path(), false), expected);
        // Each of them may be watched itself.
        for project in expected {
            let project = root.path().join(project);
            let found = walk(&project, std::slice::from_ref(&project), false, &|| {});
            assert_eq!(found.projects, [&*project]);
            let input = InputFolders::find(&project, false);
            assert_eq!(input.of_others.len(), 1, "{}", project.display());
        }
    }

    #[cfg(unix)]
    #[test]
    fn a_model_of_another_program_behind_a_link_is_none_unless_asked() {
        let outside = tempfile::tempdir().expect("a temporary folder");
        touch(outside.path(), "a.nvm");
        let root = tempfile::tempdir().expect("a temporary folder");
        touch(root.path(), "p/readme");
        symlink(outside.path().join("a.nvm"), root.path().join("p/a.nvm")).expect("a link");
        assert!(projects(root.path(), false).is_empty());
        assert_eq!(projects(root.path(), true), ["p"]);
    }

    #[test]
    fn stray_files_do_not_make_a_folder_of_projects_a_project() {
        let root = tempfile::tempdir().expect("a temporary folder");
        for path in ["group/a/sparse/0/cameras.bin", "group/b/scene.mvs"] {
            touch(root.path(), path);
        }
        fs::create_dir(root.path().join("sparse")).expect("a folder");
        for stray in [
            "images.txt",
            "cameras.txt",
            "points3D.txt",
            "scene.mvs",
            "x.ori",
        ] {
            touch(root.path(), stray);
            assert_eq!(
                projects(root.path(), false),
                ["group/a", "group/b"],
                "{stray}"
            );
        }
        touch(root.path(), "sparse/0/cameras.bin");
        assert_eq!(
            projects(root.path(), false),
            [""],
            "a project of its own around the others"
        );
    }

    #[test]
    fn a_stray_file_in_a_root_does_not_hide_projects() {
        let root = tempfile::tempdir().expect("a temporary folder");
        touch(root.path(), "a/sparse/0/cameras.bin");
        touch(root.path(), "old.mvs");
        let of_roots = |roots: &[PathBuf]| walk(root.path(), roots, false, &|| {}).projects;
        assert_eq!(of_roots(&[root.path().into()]), [root.path().join("a")]);
        assert_eq!(of_roots(&[]), [root.path()], "a scene and its inputs");
    }

    #[cfg(unix)]
    #[test]
    fn a_project_whose_name_is_not_utf_8_is_found() {
        let root = tempfile::tempdir().expect("a temporary folder");
        let project = root.path().join(OsString::from_vec(b"caf\xe9".to_vec()));
        touch(&project, "sparse/0/cameras.bin");
        assert_eq!(walk(root.path(), &[], false, &|| {}).projects, [project]);
    }

    #[cfg(unix)]
    #[test]
    fn links_out_of_the_root_are_followed_only_when_asked() {
        let outside = tempfile::tempdir().expect("a temporary folder");
        touch(outside.path(), "p/sparse/0/cameras.bin");
        let root = tempfile::tempdir().expect("a temporary folder");
        symlink(outside.path(), root.path().join("link")).expect("a link");
        assert!(projects(root.path(), false).is_empty());
        assert_eq!(projects(root.path(), true), ["link/p"]);
        touch(root.path(), "q/sparse/1/cameras.bin");
        symlink(
            outside.path().join("p/sparse/0"),
            root.path().join("q/sparse/0"),
        )
        .expect("a link");
        let project = root.path().join("q");
        let model = project.join("sparse/0");
        let models = |follow_links| InputFolders::find(&project, follow_links).models;
        assert!(!models(false).contains(&model) && models(true).contains(&model));
        assert!(models(false).contains(&project.join("sparse/1")));
        symlink(
            outside.path().join("p/sparse/0/cameras.bin"),
            project.join("sparse/1/images.bin"),
        )
        .expect("a link");
        assert!(!may_enter(
            &project,
            &project.join("sparse/1/images.bin"),
            false
        ));
        fs::create_dir(root.path().join("all behind links")).expect("a folder");
        symlink(
            outside.path().join("p/sparse"),
            root.path().join("all behind links/sparse"),
        )
        .expect("a link");
        assert_eq!(
            projects(root.path(), false),
            ["all behind links", "q"],
            "listed so that the status can give the reason"
        );
    }

    #[cfg(unix)]
    #[test]
    fn no_folder_is_entered_twice_through_links() {
        let root = tempfile::tempdir().expect("a temporary folder");
        for folder in ["a", "b"] {
            touch(root.path(), &format!("{folder}/p/sparse/0/cameras.bin"));
            for link in ["0", "again", "and again"] {
                symlink(root.path(), root.path().join(folder).join(link)).expect("a link");
            }
        }
        let entered = std::cell::Cell::new(0);
        let found = walk(root.path(), &[], true, &|| entered.set(entered.get() + 1));
        assert_eq!(
            found.projects,
            ["a/p", "b/p"].map(|p| root.path().join(p)),
            "by their own paths"
        );
        assert_eq!(entered.get(), 5 + 6, "each folder and each link");
    }
}
