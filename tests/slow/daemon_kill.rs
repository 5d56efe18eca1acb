//! Kills the daemon at random instants while projects change: its final outputs equal those of an
//! undisturbed run, byte for byte.
//!
//! 100 kills by default; VIEWRANK_KILLS sets another number.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    thread,
    time::{Duration, Instant, UNIX_EPOCH},
};

use rand_core::{Rng, SeedableRng};
use rand_pcg::Pcg64;
use viewrank_core::{
    method::synthetic::Town,
    model::camera::{Camera, CameraModel},
};
use viewrank_io::{
    formats::{colmap::ColmapModel, colmap_bin},
    npy,
};

const PROJECTS: [&str; 3] = ["a", "deep/b", "with blank/c"];
/// A project with a constant model whose depth maps come and go.
const COMPUTED: &str = "computed";
/// Number of models that a project may have.
const VARIANTS: u64 = 2;
/// Number of finished depth maps, if there are any.
const MAPS: usize = 2;
/// Files that every run writes anew.
const NOT_COMPARED: [&str; 2] = ["timings.json", ".lock"];
/// Latest time of a kill after the start.
const LATEST: Duration = Duration::from_millis(500);
/// Time limit for a daemon to start writing.
const PATIENCE: Duration = Duration::from_secs(30);

fn model(variant: u64) -> Vec<(&'static str, Vec<u8>)> {
    let camera = Camera::new(
        1,
        CameraModel::Pinhole,
        400,
        300,
        vec![320.0, 320.0, 200.0, 150.0],
    )
    .expect("a camera");
    let town = Town {
        grid: 3,
        points: 400,
        tilt: None,
        side: 40.0,
        boxes: 1,
        seed: variant,
        ..Town::new(camera)
    };
    colmap_bin::write(&ColmapModel::from_scene(&town.scene()))
}

/// Replaces the model file by file, like a copying program.
fn put_model(project: &Path, variant: u64) {
    let folder = project.join("sparse/0");
    fs::create_dir_all(&folder).expect("a folder");
    for (name, bytes) in model(variant) {
        fs::write(folder.join(name), bytes).expect("a file");
    }
}

/// Writes depth maps of these key views; every second pixel has the depth of the ground, the others
/// none.
fn put_maps(project: &Path, keys: &[String]) {
    let folder = project.join("sgm/depth_maps");
    fs::create_dir_all(&folder).expect("a folder");
    for (i, key) in keys.iter().enumerate() {
        let depths = (0..150 * 200).map(|at| if at % 2 == 0 { 40.0f32 } else { 0.0 });
        let bytes = npy::write(&[150, 200], depths);
        let path = folder.join(format!("{key}.npy"));
        fs::write(&path, bytes).expect("a file");
        // The time per pair is computed from these times.
        let time = UNIX_EPOCH + Duration::from_secs(1_700_000_000 + 60 * i as u64);
        fs::File::options()
            .write(true)
            .open(&path)
            .and_then(|file| file.set_modified(time))
            .expect("a time");
    }
}

fn daemon(root: &Path, options: &[&str]) -> Command {
    let nowhere = Path::new(env!("CARGO_TARGET_TMPDIR"));
    let mut command = Command::new(env!("CARGO_BIN_EXE_viewrank"));
    command
        .arg("watch")
        .arg(root)
        .args(["--settle", "30ms", "--jobs", "2", "--replan"])
        .args(options);
    command
        .env("XDG_CONFIG_HOME", nowhere)
        .stderr(Stdio::null());
    command
}

/// Plans all projects, undisturbed.
fn finish(root: &Path) {
    let ended = daemon(root, &["--once"])
        .stderr(Stdio::piped())
        .output()
        .expect("the program ends");
    assert!(
        ended.status.success(),
        "{}: {}",
        ended.status,
        String::from_utf8_lossy(&ended.stderr)
    );
}

/// Reads all files of the project's output folder, except those that differ from run to run. The
/// project's path in warnings is replaced.
fn outputs(project: &Path) -> Outputs {
    let folder = project.join("viewrank");
    // A running daemon may remove files during the walk.
    let files = walkdir::WalkDir::new(&folder)
        .into_iter()
        .filter_map(Result::ok);
    let files = files.filter(|e| {
        e.file_type().is_file() && !NOT_COMPARED.iter().any(|name| e.file_name() == *name)
    });
    // As it is, and as JSON escapes the separators of Windows.
    let root = project.to_string_lossy();
    let escaped = root.replace('\\', r"\\");
    let read = |e: walkdir::DirEntry| {
        let name = e
            .path()
            .strip_prefix(&folder)
            .expect("below the folder")
            .to_path_buf();
        let bytes = fs::read(e.path()).ok()?;
        let without = |text: String| text.replace(&escaped, "PROJECT").replace(&*root, "PROJECT");
        let text = String::from_utf8(bytes).map(|text| without(text).into_bytes());
        Some((name, text.unwrap_or_else(|error| error.into_bytes())))
    };
    files.filter_map(read).collect()
}

/// Clears the records of file sets: they contain the hash of `timings.json`, so that only their
/// names are compared.
fn without_hashes(mut outputs: Outputs) -> Outputs {
    outputs
        .iter_mut()
        .filter(|(path, _)| path.starts_with(".sets"))
        .for_each(|(_, bytes)| bytes.clear());
    outputs
}

/// The projects, their current input, and the outputs of undisturbed runs for every input.
struct Scene {
    root: tempfile::TempDir,
    random: Pcg64,
    variants: [u64; PROJECTS.len()],
    has_maps: bool,
    /// Key views with depth maps.
    keys: Vec<String>,
    planned: Vec<Outputs>,
    /// Without and with depth maps.
    computed: [Outputs; 2],
    /// Duration of a run.
    length: Duration,
}

type Outputs = BTreeMap<PathBuf, Vec<u8>>;

/// Number of kills by what they interrupted.
#[derive(Default, Debug)]
struct Hits {
    /// A file set or a status was half written.
    writing: u64,
    /// The change was not planned or measured yet.
    unfinished: u64,
}

impl Scene {
    fn new(seed: u64) -> Self {
        let start = Instant::now();
        let planned: Vec<Outputs> = (0..VARIANTS)
            .map(|variant| undisturbed(variant, &[]))
            .collect();
        let length = (start.elapsed() / VARIANTS as u32).min(LATEST);
        let clusters =
            String::from_utf8(planned[0][Path::new("clusters.txt")].clone()).expect("text");
        let keys: Vec<String> = clusters
            .lines()
            .take(MAPS)
            .map(|line| line.split('\t').next().unwrap_or("").into())
            .collect();
        let computed = [planned[0].clone(), undisturbed(0, &keys)];
        assert_ne!(
            computed[0][Path::new("manifest.json")],
            computed[1][Path::new("manifest.json")]
        );
        let root = tempfile::tempdir().expect("a temporary folder");
        PROJECTS
            .iter()
            .chain([&COMPUTED])
            .for_each(|project| put_model(&root.path().join(project), 0));
        let (random, variants) = (Pcg64::seed_from_u64(seed), [0; PROJECTS.len()]);
        Self {
            root,
            random,
            variants,
            has_maps: false,
            keys,
            planned,
            computed,
            length,
        }
    }

    fn chance(&mut self, one_in: u32) -> bool {
        self.random.next_u32().is_multiple_of(one_in)
    }

    /// Changes a random project and returns it.
    fn change(&mut self) -> &'static str {
        if self.chance(3) {
            self.has_maps = !self.has_maps;
            let project = self.root.path().join(COMPUTED);
            if self.has_maps {
                put_maps(&project, &self.keys)
            } else {
                fs::remove_dir_all(project.join("sgm")).expect("maps")
            }
            return COMPUTED;
        }
        let at = self.random.next_u32() as usize % PROJECTS.len();
        self.variants[at] = (self.variants[at] + 1) % VARIANTS;
        put_model(&self.root.path().join(PROJECTS[at]), self.variants[at]);
        PROJECTS[at]
    }

    fn expected(&self, project: &str) -> &Outputs {
        match PROJECTS.iter().position(|p| *p == project) {
            Some(at) => &self.planned[self.variants[at] as usize],
            None => &self.computed[usize::from(self.has_maps)],
        }
    }

    fn found(&self, project: &str) -> Outputs {
        without_hashes(outputs(&self.root.path().join(project)))
    }

    fn is_finished(&self, project: &str) -> bool {
        self.found(project) == *self.expected(project)
    }

    /// Starts a daemon, changes a project and kills the daemon.
    fn kill_one(&mut self, hits: &mut Hits) {
        let mut running = daemon(self.root.path(), &[])
            .spawn()
            .expect("the program starts");
        let changed = self.change();
        if self.chance(2) {
            let end = Instant::now() + PATIENCE;
            let folder = self.root.path().join(changed);
            // Comparing all outputs is slow, so it is done rarely.
            let looks = (0..).take_while(|_| Instant::now() < end && !is_writing(&folder));
            looks
                .map(|look| look % 50 == 49 && self.is_finished(changed))
                .take_while(|finished| !finished)
                .for_each(|_| {
                    thread::sleep(Duration::from_millis(1));
                });
            thread::sleep(Duration::from_micros(u64::from(
                self.random.next_u32() % 20_000,
            )));
        } else {
            thread::sleep(self.length * (self.random.next_u32() % 1000) / 1000);
        }
        running.kill().expect("SIGKILL");
        running.wait().expect("the end");
        let writing = PROJECTS
            .iter()
            .chain([&COMPUTED, &""])
            .any(|p| is_writing(&self.root.path().join(p)));
        hits.writing += u64::from(writing);
        hits.unfinished += u64::from(!self.is_finished(changed));
    }
}

/// True if a file set is staged, or a draft of a status or progress file exists.
fn is_writing(folder: &Path) -> bool {
    let unfinished = [
        ".staging",
        ".journal.json",
        ".status.json.new",
        ".progress.json.new",
    ];
    unfinished
        .iter()
        .any(|name| folder.join("viewrank").join(name).exists())
}

#[test]
fn a_daemon_killed_at_any_instant_ends_with_the_outputs_of_an_undisturbed_one() {
    let kills: u64 = std::env::var("VIEWRANK_KILLS")
        .ok()
        .and_then(|n| n.parse().ok())
        .unwrap_or(100);
    let mut scene = Scene::new(kills);
    let mut hits = Hits::default();
    (0..kills).for_each(|_| scene.kill_one(&mut hits));
    eprintln!("{kills} kills: {hits:?}");
    assert!(
        hits.unfinished >= kills / 3,
        "most kills must hit work: {hits:?}"
    );
    assert!(
        hits.writing >= kills / 20,
        "some kills must hit what is being written: {hits:?}"
    );
    finish(scene.root.path());
    for project in PROJECTS.iter().chain([&COMPUTED]) {
        let (found, expected) = (scene.found(project), scene.expected(project));
        assert_eq!(
            found.keys().collect::<Vec<_>>(),
            expected.keys().collect::<Vec<_>>(),
            "{project}"
        );
        for (path, bytes) in &found {
            assert!(
                bytes == &expected[path],
                "{project}: {} differs",
                path.display()
            );
        }
    }
}

/// Returns the outputs of an undisturbed run on a project with this model and depth maps of these
/// views. The folder has the name of one of the projects, because a manifest may contain it.
fn undisturbed(variant: u64, maps: &[String]) -> Outputs {
    let root = tempfile::tempdir().expect("a temporary folder");
    let project = root.path().join(PROJECTS[0]);
    put_model(&project, variant);
    if !maps.is_empty() {
        put_maps(&project, maps);
    }
    finish(root.path());
    let outputs = without_hashes(outputs(&project));
    assert!(
        outputs.contains_key(Path::new("manifest.json")),
        "{:?}",
        outputs.keys()
    );
    assert_eq!(
        outputs.contains_key(Path::new("progress.json")),
        !maps.is_empty()
    );
    outputs
}
