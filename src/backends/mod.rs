//! The MVS programs that viewrank writes for, in one table: [`BACKENDS`]. Everything about a
//! program is in its own file.
//!
//! A [`Backend`] gives the numbers that a plan is made with (gate, confidence, support), and turns
//! a [`Selection`] into the files that make the program compute the chosen view clusters. It
//! returns the files; [`crate::io::output`] writes them.

use std::path::Path;

use serde::Serialize;

use crate::{
    config::{Settings, UnknownBackend},
    io::project::Project,
    method::confidence::Photometric,
    model::{camera::Camera, cluster::Gate},
    plan::{Matcher, PlanningNumbers},
};

mod alicevision;
mod clusters;
mod colmap;
mod error;
mod gipuma;
mod images;
mod listing;
mod machine;
mod metashape;
mod micmac;
mod mve;
mod odm;
mod openmvs;
mod options;
mod pairs;
pub mod place;
mod pmvs;
mod realityscan;
mod record;
mod runner;
mod selection;
mod semi_global;
mod sgm;
mod splat;
mod strangers;
mod sure;
mod tiles;
mod traps;
mod workspace;

pub use clusters::{hash, task_ids, task_marker};
pub use error::BackendError;
pub use listing::{FIRST_PAGE, LastRun, names};
pub use machine::{
    Choice, NotReady, by_default, can_match_here, chosen, not_ready, not_ready_here, python,
};
pub use options::{ExportOptions, References};
pub use record::{Export, ExportRecord, ExportedCluster, ExportedView};
pub use runner::{Call, Product, TaskProgram, TaskRunner, Tasks};
pub use selection::{CUT_PANORAMAS, Selection, cure_of_images, has_panoramas, of_unread_kind};
pub use semi_global::pair_files;
pub use strangers::with_refusal;
pub use tiles::clusters_by_area;
pub use traps::{ExaminedProject, Trap};

/// Every backend, in the order in which `viewrank backends` lists them: those of the [first
/// page](FIRST_PAGE), then the others.
pub static BACKENDS: &[&Backend] = &[
    &colmap::BACKEND,
    &openmvs::BACKEND,
    &odm::BACKEND,
    &metashape::BACKEND,
    &splat::BACKEND,
    &pairs::PAIRS,
    &sgm::BACKEND,
    &pairs::MVSNET,
    &pairs::PATCHMATCHNET,
    &pairs::ACMM,
    &sure::BACKEND,
    &mve::BACKEND,
    &pmvs::BACKEND,
    &gipuma::BACKEND,
    &micmac::BACKEND,
    &alicevision::BACKEND,
    &realityscan::BACKEND,
    &images::BACKEND,
];

/// Tells whether the depth map at a path was made for the exported plan.
pub type KnownMaps = Box<dyn Fn(&Path) -> bool + Send + Sync>;

/// An MVS program: its name, what it honours of a plan, the numbers it is planned with, and its
/// files.
pub struct Backend {
    /// Value of `--backend`.
    pub name: &'static str,
    /// Other names that users type, in lower case without blanks, `-` and `_`.
    pub aliases: &'static [&'static str],
    /// The programs, for people.
    pub program: &'static str,
    pub last_run: LastRun,
    pub capabilities: Capabilities,
    pub planning: PlanningNumbers,
    /// Options of `viewrank export` that it accepts besides `--out`, as typed.
    pub options: &'static [&'static str],
    /// Verb for the use of key views by programs without depth maps: "Train on" (6 of 28 images).
    pub use_of_views: Option<&'static str>,
    /// Default size of the matched images of a camera, over their own size.
    pub own_scale: fn(&Camera) -> f64,
    /// True if it supports cameras with lens distortion.
    pub takes_distorted: bool,
    /// Extensions of images that its program does not read, in lower case.
    pub unread: &'static [&'static str],
    /// True if its program reads raw pictures of cameras.
    pub reads_raw: bool,
    /// True if it takes the masks where viewrank finds them.
    pub takes_masks: bool,
    /// True if the project is set up for it; `plan` then writes its files by default.
    pub serves: fn(&Project) -> bool,
    /// True if its exports match key views at full and at half size, and fuse their depth maps
    /// (method 5.8).
    pub mixes_sizes: bool,
    /// How `viewrank run` computes its depth maps; `None` if the program can only run as a whole.
    pub tasks: Option<Tasks>,
    /// Looks at the folder of its depth maps; returns whether one below was made for the plan that
    /// was exported there. Where only exports write, all are.
    pub known_maps: fn(&Path) -> KnownMaps,
    /// Faults of a project that break the backend with any plan, besides distorted cameras.
    pub traps: fn(&ExaminedProject) -> Vec<Trap>,
    export: fn(&Selection, &ExportOptions) -> Result<Export, BackendError>,
}

impl Backend {
    /// Fields that most rows share: the program can only run as a whole, on undistorted images at
    /// their own size. Names, numbers and the export are set by each row.
    const DEFAULT: Self = Self {
        name: "",
        aliases: &[],
        program: "",
        last_run: LastRun::Never(""),
        capabilities: Capabilities {
            partners: Honours::Yes,
            key_subset: Honours::Yes,
            order: Honours::Yes,
            fusion: "",
            notes: "",
        },
        planning: PATCH_MATCH,
        options: &[],
        use_of_views: None,
        own_scale: full_size,
        takes_distorted: false,
        unread: &[],
        reads_raw: false,
        takes_masks: false,
        serves: |_| false,
        mixes_sizes: false,
        tasks: None,
        known_maps: |_| Box::new(|_| true),
        traps: |_| Vec::new(),
        // Every backend replaces it: the tests that export for all of them would find one that does
        // not.
        export: |_, _| {
            Err(BackendError::Needs {
                backend: "",
                what: "an export of its own".into(),
                hint: "write one in src/backends".into(),
            })
        },
    };

    /// Makes the files for a selection, at the backend's default image size unless the user has set
    /// one; writes nothing.
    ///
    /// # Errors
    /// Fails on unsupported images, names or cameras, and on options that do not fit the project.
    pub fn export(
        &self,
        selection: &Selection,
        options: &ExportOptions,
    ) -> Result<Export, BackendError> {
        for view in selection
            .views()
            .into_iter()
            // Images for tests are named in lists, too.
            .chain(selection.kept_for_tests())
        {
            self.check_line(selection.scene.name(view))?;
        }
        (self.export)(&self.at_its_size(selection), options)
    }

    /// Returns the selection at the backend's default image size, unless the user has set one.
    pub fn at_its_size<'a>(&self, selection: &Selection<'a>) -> Selection<'a> {
        let image_scale = if selection.own_size {
            self.matcher().image_scale(selection.scene)
        } else {
            selection.image_scale
        };
        Selection {
            image_scale,
            ..*selection
        }
    }

    /// Refuses names with a line break or another control character: in a list with a name per line
    /// they are several names, and no program shows or asks for such a file.
    fn check_line(&self, name: &str) -> Result<(), BackendError> {
        if name.contains(char::is_control) {
            let why = "it has a control character, such as a line break";
            return Err(BackendError::name(self.name, name, why));
        }
        Ok(())
    }

    fn matcher(&self) -> Matcher {
        Matcher {
            name: self.name,
            numbers: self.planning,
            own_scale: self.own_scale,
            mixes_sizes: self.mixes_sizes,
            makes_maps: self.makes_maps(),
        }
    }

    /// Returns whether the program makes depth maps; if not, it uses the images themselves.
    pub fn makes_maps(&self) -> bool {
        self.use_of_views.is_none()
    }
}

/// Size of the matched images of a program that does not resize them.
fn full_size(_: &Camera) -> f64 {
    1.0
}

/// Normalises a name: lower case without blanks, `-` and `_`.
fn plain(name: &str) -> String {
    name.chars()
        .filter(|c| !c.is_whitespace() && !"-_".contains(*c))
        .flat_map(char::to_lowercase)
        .collect()
}

/// Returns the backend with this name or alias, as given to `--backend`.
pub fn by_name(name: &str) -> Result<&'static Backend, UnknownBackend> {
    let wanted = plain(name);
    let meant = |b: &&&Backend| b.name == wanted || b.aliases.contains(&&*wanted);
    BACKENDS
        .iter()
        .find(meant)
        .copied()
        .ok_or_else(|| UnknownBackend {
            name: name.trim().into(),
            meant: nearest(name),
            known: names(),
        })
}

/// Returns what tells the depth maps of a plan for this program from others in their folder.
pub fn known_maps(backend: &str, folder: &Path) -> KnownMaps {
    match by_name(backend) {
        Ok(backend) => (backend.known_maps)(folder),
        Err(_) => Box::new(|_| true),
    }
}

/// Resolves a name or alias to the backend's name;
/// [`Configuration::load`](crate::config::Configuration::load) checks settings with it.
pub fn canonical_name(name: &str) -> Result<&'static str, UnknownBackend> {
    by_name(name).map(|backend| backend.name)
}

/// Returns what a user has to know of the shares that a program's depth maps are said to reach.
pub fn caution(name: &str) -> Option<&'static str> {
    by_name(name).ok()?.planning.caution
}

/// Returns the backends with these names, in their order, without repetition.
pub fn by_names(names: &[String]) -> Result<Vec<&'static Backend>, UnknownBackend> {
    let mut backends: Vec<&'static Backend> = Vec::new();
    for name in names {
        let backend = by_name(name)?;
        if backends.iter().all(|known| known.name != backend.name) {
            backends.push(backend);
        }
    }
    Ok(backends)
}

/// Longest name that is compared with the known ones, bytes: the time grows with its length.
const LONGEST_NAME: usize = 100;

/// Returns the known name most similar to the given one.
fn nearest(name: &str) -> Option<&'static str> {
    if name.len() > LONGEST_NAME {
        return None;
    }
    let wanted = plain(name);
    let others = BACKENDS
        .iter()
        .flat_map(|b| b.aliases.iter().map(|other| (*other, b.name)));
    let known = BACKENDS.iter().map(|b| (b.name, b.name)).chain(others);
    let rated = known.map(|(known, name)| (strsim::jaro_winkler(known, &wanted), name));
    rated
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .filter(|(likeness, _)| *likeness > 0.8)
        .map(|(_, name)| name)
}

/// Returns the backend that the project is planned for: the [chosen] one.
pub fn planned_for(project: &Project, settings: &Settings) -> Result<Matcher, UnknownBackend> {
    chosen(project, settings).map(|(backend, _)| backend.matcher())
}

/// Degree to which a backend honours a part of the plan.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Honours {
    Yes,
    /// Partly; [`Capabilities::notes`] says how.
    Partly,
    No,
}

/// Degree to which a backend honours each part of a plan.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Capabilities {
    /// Exactly the given matching partners.
    pub partners: Honours,
    /// Depth maps for exactly the key views.
    pub key_subset: Honours,
    /// Key views in rank order.
    pub order: Honours,
    /// Description of the fusion of the depth maps.
    pub fusion: &'static str,
    /// Limits and conditions, as text.
    pub notes: &'static str,
}

/// By COLMAP's photometric depth maps of a room, the only ones of a PatchMatch on a GPU.
const BY_COLMAPS_MAPS: Photometric = Photometric {
    agree: 0.95,
    differ: 0.02,
    full_agreement: 0.9,
};

/// OpenMVS's numbers, for PatchMatch programs without measurements; `support` 2, since their fusion
/// keeps depths on which maps agree.
const PATCH_MATCH: PlanningNumbers = PlanningNumbers {
    reach: None,
    gate: Gate {
        min_shared_points: 1,
        min_angle_deg: 3.0,
        max_angle_deg: 60.0,
        max_scale_octaves: 1.68,
        epipole_inside: true,
    },
    confidence: openmvs::CONFIDENCE,
    photometric: BY_COLMAPS_MAPS,
    support: 2,
    work: openmvs::WORK,
    measured: "no: openmvs's",
    caution: Some(
        "Its depth maps were never compared with a plan: shares are what OpenMVS would reach.",
    ),
    source: "not measured: gate and geometric confidence of OpenMVS, agreement of COLMAP, other PatchMatches (method 7.1, 7.2); support 2: depth \
             maps are joined where they agree",
};

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::error::Hint;

    #[test]
    fn names_are_unique_and_found() {
        let names = || {
            BACKENDS.iter().flat_map(|b| {
                b.aliases
                    .iter()
                    .chain([&b.name])
                    .map(|name| (*name, b.name))
            })
        };
        for (name, meant) in names() {
            assert_eq!(by_name(name).unwrap().name, meant);
            assert_eq!(
                names().filter(|(other, _)| *other == name).count(),
                1,
                "{name}"
            );
            assert_eq!(plain(name), name);
        }
        let rows = BACKENDS
            .iter()
            .map(|b| [b.name, b.program, b.capabilities.fusion]);
        assert!(rows.flatten().all(|own| !own.is_empty()));
        assert!(
            by_name("nothing").is_err_and(|e| e.hint().unwrap().to_string().contains("openmvs"))
        );
    }

    #[test]
    fn names_are_understood_as_people_type_them() {
        for (typed, meant) in [
            ("COLMAP", "colmap"),
            (" OpenMVS ", "openmvs"),
            ("Meshroom", "alicevision"),
            ("3DGS", "splat"),
            ("Reality Capture", "realityscan"),
        ] {
            assert_eq!(by_name(typed).unwrap().name, meant);
        }
        let once = by_names(&["openmvs".into(), "COLMAP".into(), "OpenMVS".into()]).unwrap();
        assert_eq!(
            once.iter().map(|b| b.name).collect::<Vec<_>>(),
            ["openmvs", "colmap"]
        );
        let hint = |name: &str| by_name(name).err().unwrap().hint().unwrap().to_string();
        assert!(hint("colmpa").starts_with("did you mean colmap? take one of colmap, "));
        assert!(hint("xyz").starts_with("take one of colmap, openmvs, "));
        assert!(hint("xyz").ends_with("and 12 others (docs/programs.md)"));
    }
}
