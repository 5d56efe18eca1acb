//! Files whose contents take far more memory than they have bytes, against the program with a limit
//! on its memory: each is refused or left out with a reason. And the daemon, which goes on whatever
//! becomes of a plan.
#![cfg(target_os = "linux")]

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Child, Command, Output, Stdio},
    time::{Duration, Instant},
};

use miniz_oxide::deflate::compress_to_vec_zlib;
use serde_json::Value;
use tempfile::TempDir;

use super::valley;

/// Address space, KiB, of which the program itself and its threads take a quarter.
const MOST_MEMORY_KIB: u64 = 2 << 20;

/// A root with projects that have the model and the images of a fixture.
struct Root {
    folder: TempDir,
}

impl Root {
    fn new(projects: &[&str]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        for project in projects {
            valley::copy_to(&folder.path().join(project));
        }
        Self { folder }
    }

    fn project(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn state_of(&self, project: &str) -> Option<Value> {
        let status = fs::read(self.folder.path().join("viewrank/status.json")).ok()?;
        let status: Value = serde_json::from_slice(&status).ok()?;
        status["projects"]
            .as_array()?
            .iter()
            .find(|found| found["project"] == project)
            .cloned()
    }

    fn watch(&self, options: &[&str]) -> Command {
        let mut arguments = vec!["watch", text(self.folder.path()), "--settle", "10ms"];
        arguments.extend(options);
        viewrank(&arguments)
    }
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// The program within the limit of memory, on two threads: each reserves address space.
fn viewrank(arguments: &[&str]) -> Command {
    viewrank_within(MOST_MEMORY_KIB, arguments)
}

fn viewrank_within(most_memory_kib: u64, arguments: &[&str]) -> Command {
    let mut command = Command::new("sh");
    let limited = format!("ulimit -c 0; ulimit -v {most_memory_kib}; exec \"$@\"");
    command
        .args(["-c", &limited, "sh", env!("CARGO_BIN_EXE_viewrank")])
        .args(arguments);
    command
        .env("XDG_CONFIG_HOME", env!("CARGO_TARGET_TMPDIR"))
        .env("RAYON_NUM_THREADS", "2");
    command
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[track_caller]
fn succeeds(mut command: Command) -> String {
    let output = command.output().unwrap();
    assert!(
        output.status.success(),
        "{}: {}",
        output.status,
        said(&output)
    );
    said(&output)
}

/// The error of a call that must end by itself, with an error.
#[track_caller]
fn fails(mut command: Command) -> String {
    let output = command.output().unwrap();
    assert!(
        matches!(output.status.code(), Some(1 | 2)),
        "{}: {}",
        output.status,
        said(&output)
    );
    said(&output)
}

/// A chunk of a PNG (PNG specification, 5.3).
fn chunk(kind: &[u8; 4], data: &[u8]) -> Vec<u8> {
    let checked = [kind, data].concat();
    let mut crc = u32::MAX;
    for byte in &checked {
        crc ^= u32::from(*byte);
        (0..8).for_each(|_| crc = crc >> 1 ^ if crc & 1 == 1 { 0xedb8_8320 } else { 0 });
    }
    [
        &(data.len() as u32).to_be_bytes()[..],
        &checked,
        &(!crc).to_be_bytes(),
    ]
    .concat()
}

/// A PNG of 8-bit RGB whose pixels are `data`, deflated, after other chunks.
fn png(width: u32, height: u32, others: &[u8], data: &[u8]) -> Vec<u8> {
    let header = [
        &width.to_be_bytes()[..],
        &height.to_be_bytes(),
        &[8, 2, 0, 0, 0],
    ]
    .concat();
    let start = [b"\x89PNG\r\n\x1a\n", &chunk(b"IHDR", &header)[..]].concat();
    [&start, others, &chunk(b"IDAT", data), &chunk(b"IEND", b"")].concat()
}

/// Writes an OpenEXR of a few kilobytes and a hole that claims this many pixels in each direction.
fn write_exr(path: &Path, side: i32) {
    let mut bytes =
        fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/depthmaps/40_depthMap.exr"))
            .unwrap();
    let at = bytes
        .windows(11)
        .position(|w| w == b"dataWindow\0")
        .unwrap()
        + 11
        + 6
        + 4;
    for (axis, value) in [0, 0, side - 1, side - 1].into_iter().enumerate() {
        bytes[at + 4 * axis..][..4].copy_from_slice(&value.to_le_bytes());
    }
    fs::write(path, bytes).unwrap();
    // As many bytes as deflated pixels would have at least.
    fs::File::options()
        .write(true)
        .open(path)
        .unwrap()
        .set_len(16 << 20)
        .unwrap();
}

#[test]
fn a_depth_map_that_claims_gigapixels_is_left_out_by_evaluate_and_watch() {
    let root = Root::new(&["p", "q"]);
    let settings = root.project("p").join("viewrank.toml");
    fs::write(settings, "backends = [\"alicevision\"]\n").unwrap();
    succeeds(root.watch(&["--once"]));
    let maps = root.project("p").join("alicevision");
    fs::create_dir(&maps).unwrap();
    for id in 1..60 {
        write_exr(&maps.join(format!("{id}_depthMap.exr")), 60_000);
    }
    let evaluation = viewrank(&[
        "evaluate",
        text(&root.project("p")),
        "--depth-maps",
        text(&maps),
    ]);
    let error = fails(evaluation);
    assert!(
        error.contains("_depthMap.exr") && error.contains("60000 x 60000 pixels, at most"),
        "{error}"
    );
    succeeds(root.watch(&["--once"]));
    assert_eq!(root.state_of("q").unwrap()["state"], "planned");
    let note = root.state_of("p").unwrap().to_string();
    assert!(note.contains("60000 x 60000 pixels, at most"), "{note}");
}

/// Writes a depth map of the fixture's size as a NumPy file, the same depth in each pixel.
fn write_flat_map(path: &Path, depth: f32) {
    let header = "{'descr': '<f4', 'fortran_order': False, 'shape': (450, 600), }";
    let header = format!("{header:<117}\n");
    let length = (header.len() as u16).to_le_bytes();
    let start = [b"\x93NUMPY\x01\0", &length[..], header.as_bytes()].concat();
    let pixels = depth.to_le_bytes().repeat(450 * 600);
    fs::write(path, [start, pixels].concat()).unwrap();
}

#[test]
fn depths_a_million_times_as_far_as_the_scene_make_no_cells() {
    let root = Root::new(&["p"]);
    let project = root.project("p");
    succeeds(viewrank(&["plan", text(&project), "--backend", "sgm"]));
    let maps = root.folder.path().join("maps");
    fs::create_dir(&maps).unwrap();
    let image = |entry: std::io::Result<fs::DirEntry>| entry.unwrap().file_name();
    let images = fs::read_dir(project.join("images")).unwrap().map(image);
    let mut images: Vec<String> = images.map(|name| name.into_string().unwrap()).collect();
    images.sort();
    for (name, depth) in images.iter().zip([25.0, 25e6, 25e12, 25e-6]) {
        write_flat_map(&maps.join(format!("{name}.npy")), depth);
    }
    succeeds(viewrank(&[
        "evaluate",
        text(&project),
        "--depth-maps",
        text(&maps),
    ]));
    let cells = fs::read_to_string(project.join("viewrank/evaluation/cells.tsv")).unwrap();
    let (names, rows) = cells.split_once('\n').unwrap();
    let near = names.split('\t').position(|name| name == images[0]);
    let row = format!("\t{:x}", 1 << near.unwrap());
    assert!(rows.lines().count() == 1, "{cells}");
    assert!(rows.trim_end().ends_with(&row), "{cells}");
}

#[test]
fn images_and_masks_that_claim_too_many_pixels_or_a_large_profile_are_named() {
    let root = Root::new(&["p"]);
    let project = root.project("p");
    let images: Vec<PathBuf> = fs::read_dir(project.join("images"))
        .unwrap()
        .map(|e| e.unwrap().path())
        .collect();
    let name = |image: &Path| image.file_name().unwrap().to_str().unwrap().to_owned();
    let huge = png(20_000, 15_000, b"", &compress_to_vec_zlib(&[0; 1 << 20], 1));
    fs::write(&images[0], &huge).unwrap();
    // A profile of 600 MB in as many kilobytes.
    let profile = [
        b"icc\0\0",
        &compress_to_vec_zlib(&vec![0; 600 << 20], 1)[..],
    ]
    .concat();
    let pixels = compress_to_vec_zlib(&vec![0; (3 * 600 + 1) * 450], 1);
    fs::write(
        &images[1],
        png(600, 450, &chunk(b"iCCP", &profile), &pixels),
    )
    .unwrap();
    let masks = project.join("masks");
    fs::create_dir(&masks).unwrap();
    fs::write(masks.join(format!("{}.png", name(&images[2]))), &huge).unwrap();
    succeeds(viewrank(&["plan", text(&project)]));
    let manifest = fs::read(project.join("viewrank/manifest.json")).unwrap();
    let manifest: Value = serde_json::from_slice(&manifest).unwrap();
    let warnings = manifest["warnings"].to_string();
    let of_bytes = "(of more pixels than its bytes can show)";
    let said = format!("{} {of_bytes}", name(&images[0]));
    assert!(warnings.contains(&said), "{warnings}");
    assert!(
        warnings.contains(&format!(
            "{}: its mask: 20000 x 15000 pixels, at most",
            name(&images[2])
        )),
        "{warnings}"
    );
    assert!(!warnings.contains(&name(&images[1])), "{warnings}");
}

/// Writes the camera of the fixture with so many times its pixels in each direction.
fn write_enlarged_camera(project: &Path, times: u32) {
    let path = project.join("sparse/0/cameras.bin");
    let camera = fs::read(&path).unwrap();
    // A count, an id, a model, two sides and four parameters.
    let (head, rest) = camera.split_at(16);
    let (sides, params) = rest.split_at(16);
    let side = |bytes: &[u8; 8]| (u64::from_le_bytes(*bytes) * u64::from(times)).to_le_bytes();
    let param = |bytes: &[u8; 8]| (f64::from_le_bytes(*bytes) * f64::from(times)).to_le_bytes();
    let sides: Vec<u8> = sides.as_chunks().0.iter().flat_map(side).collect();
    let params: Vec<u8> = params.as_chunks().0.iter().flat_map(param).collect();
    assert_eq!(params.len(), 32, "one camera");
    fs::write(&path, [head, &sides, &params].concat()).unwrap();
}

#[test]
fn cameras_that_claim_many_times_the_pixels_of_their_images_are_refused() {
    let root = Root::new(&["p"]);
    let project = root.project("p");
    write_enlarged_camera(&project, 50);
    let plan = ["plan", text(&project), "--backend", "sgm"];
    let error = fails(viewrank(&plan));
    assert!(
        error.contains("0.0200 times the size of their cameras"),
        "{error}"
    );
    assert!(error.contains("set image_scale = 0.0200"), "{error}");
    fs::write(project.join("viewrank.toml"), "image_scale = 0.0200").unwrap();
    succeeds(viewrank(&[&plan[..], &["--dry-run"]].concat()));
}

#[test]
fn cameras_that_claim_gigapixels_are_refused_where_no_image_shows_them() {
    let root = Root::new(&["p"]);
    let project = root.project("p");
    write_enlarged_camera(&project, 62);
    fs::remove_dir_all(project.join("images")).unwrap();
    let error = fails(viewrank(&["plan", text(&project), "--backend", "sgm"]));
    assert!(error.contains("37200 x 27900 pixels"), "{error}");
    assert!(error.contains("set image_scale = 0.50"), "{error}");
}

#[test]
fn pictures_that_shrink_to_a_fivehundredth_are_decoded_one_at_a_time() {
    let root = Root::new(&["p"]);
    let project = root.project("p");
    write_enlarged_camera(&project, 25);
    let [width, height] = [25 * 600, 25 * 450];
    let plane = compress_to_vec_zlib(&vec![0; (3 * width + 1) * height], 1);
    // As many bytes as a photograph of that size might have.
    let filling = chunk(b"viEw", &vec![0; 512 << 10]);
    let picture = png(width as u32, height as u32, &filling, &plane);
    let mut images: Vec<PathBuf> = fs::read_dir(project.join("images"))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .collect();
    images.sort();
    for image in &images[..4] {
        fs::write(image, &picture).unwrap();
    }
    fs::write(project.join("viewrank.toml"), "image_scale = 0.04\n").unwrap();
    let plan = ["plan", text(&project), "--backend", "sgm", "--dry-run"];
    let said = succeeds(viewrank_within(3 << 19, &plan));
    for image in &images[..4] {
        let name = image.file_name().unwrap().to_str().unwrap();
        assert!(!said.contains(name), "{said}");
    }
}

#[test]
fn a_region_of_millions_of_positions_is_refused() {
    let root = Root::new(&["p"]);
    let region = root.folder.path().join("region.geojson");
    let ring = "[0,0],[0,1],".repeat(5_000_000);
    fs::write(
        &region,
        format!("{{\"type\":\"Polygon\",\"coordinates\":[[{ring}[0,0]]]}}"),
    )
    .unwrap();
    let error = fails(viewrank(&[
        "plan",
        text(&root.project("p")),
        "--region",
        text(&region),
    ]));
    assert!(
        error.contains("more than 1000000 positions: simplify"),
        "{error}"
    );
}

#[test]
fn models_of_short_lines_and_unknown_fields_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let model = folder.path().join("sparse/0");
    fs::create_dir_all(&model).unwrap();
    for name in ["cameras.txt", "images.txt", "points3D.txt"] {
        fs::write(model.join(name), "0\n".repeat(20_000_000)).unwrap();
    }
    let error = fails(viewrank(&["inspect", text(folder.path())]));
    assert!(
        error.contains("cameras.txt") && error.contains("line 1"),
        "{error}"
    );
    let folder = tempfile::tempdir().unwrap();
    let unknown = format!(
        "{{\"unknown\":[{}0],\"frames\":[]}}",
        "0,".repeat(30_000_000)
    );
    fs::write(folder.path().join("transforms.json"), unknown).unwrap();
    succeeds(viewrank(&["inspect", text(folder.path())]));
    let long = format!("/{}x.jpg", "a/".repeat(1_000_000));
    let frame = format!(
        "{{\"file_path\":\"{long}\",\"transform_matrix\":[[1,0,0,0],[0,1,0,0],[0,0,1,0]]}}"
    );
    fs::write(
        folder.path().join("transforms.json"),
        format!("{{\"frames\":[{frame}]}}"),
    )
    .unwrap();
    fails(viewrank(&["inspect", text(folder.path())]));
}

#[test]
fn xml_of_more_records_than_any_model_has_is_refused() {
    let sensors = [
        "<document><chunk><sensors>",
        "<sensor/>",
        "</sensors></chunk></document>",
    ];
    let components = [
        "<document><chunk><components>",
        "<component/>",
        "</components></chunk></document>",
    ];
    let photos = [
        "<BlocksExchange><Block><Photogroups><Photogroup>",
        "<Photo/>",
        "</Photogroup></Photogroups></Block></BlocksExchange>",
    ];
    let groups = [
        "<BlocksExchange><Block><Photogroups>",
        "<Photogroup/>",
        "</Photogroups></Block></BlocksExchange>",
    ];
    for [before, record, behind] in [sensors, components, photos, groups] {
        let folder = tempfile::tempdir().unwrap();
        let text = [before, &record.repeat(1 << 19), behind].concat();
        fs::write(folder.path().join("model.xml"), text).unwrap();
        let error = fails(viewrank(&["inspect", self::text(folder.path())]));
        assert!(error.contains("at most 262144"), "{record}: {error}");
    }
}

#[test]
fn of_records_of_xml_only_what_they_say_is_kept() {
    let inspected = |text: String| {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("cameras.xml"), text).unwrap();
        viewrank_within(1 << 20, &["inspect", self::text(folder.path())])
            .output()
            .map(|output| (output.status.code(), said(&output)))
            .unwrap()
    };
    let many = "<a/>".repeat(60_000);
    let sensors: String = (0..100)
        .map(|id| format!("<sensor id=\"{id}\">{many}</sensor>"))
        .collect();
    let in_chunk = |text: &str| format!("<document version=\"1\"><chunk>{text}</chunk></document>");
    let (code, error) = inspected(in_chunk(&format!("<sensors>{sensors}</sensors>")));
    assert_eq!(code, Some(0), "{error}");
    // Of a group of many cameras, the label is one.
    let label = "A".repeat(1 << 20);
    let cameras = "<camera label=\"x\"/>".repeat(2000);
    let group = format!("<cameras><group label=\"{label}\">{cameras}</group></cameras>");
    let (code, error) = inspected(in_chunk(&group));
    assert_eq!(code, Some(0), "{error}");
    let attributes = format!("<a{}/>", " b=\"\"".repeat(1000)).repeat(70);
    let (code, error) = inspected(in_chunk(&format!("<transform>{attributes}</transform>")));
    assert_eq!(code, Some(1), "{error}");
    assert!(error.contains("more than 65536 elements"), "{error}");
}

#[test]
fn a_name_of_megabytes_is_refused_in_a_few_words() {
    let name = "A".repeat(4 << 20);
    let matrix = "[[1,0,0,0],[0,1,0,0],[0,0,1,0]]";
    let of_file = format!(r#"{{"file_path":"{name}","transform_matrix":{matrix}}}"#);
    let of_camera =
        format!(r#"{{"file_path":"a.jpg","camera_model":"{name}","transform_matrix":{matrix}}}"#);
    for (frame, why) in [
        (of_file, "longer than 4096 bytes"),
        (of_camera, "unknown camera model"),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let transforms = format!(r#"{{"w":10,"h":10,"fl_x":9,"frames":[{frame}]}}"#);
        fs::write(folder.path().join("transforms.json"), transforms).unwrap();
        for arguments in [&["plan"][..], &["inspect", "--format", "json"]] {
            let arguments = [arguments, &[text(folder.path())]].concat();
            let output = viewrank(&arguments).output().unwrap();
            assert_eq!(output.status.code(), Some(1), "{}", output.status);
            assert!(
                output.stdout.len() + output.stderr.len() < 10_000,
                "{arguments:?}"
            );
            assert!(said(&output).contains(why), "{}", said(&output));
        }
        succeeds(viewrank(&[
            "watch",
            text(folder.path()),
            "--once",
            "--settle",
            "10ms",
        ]));
        let status = fs::read(folder.path().join("viewrank/status.json")).unwrap();
        assert!(status.len() < 10_000, "{}", status.len());
    }
}

#[test]
fn a_status_of_millions_of_notices_counts_as_none() {
    let root = Root::new(&["p"]);
    let root_path = text(root.folder.path());
    let status = root.folder.path().join("viewrank/status.json");
    fs::create_dir(status.parent().unwrap()).unwrap();
    for count in [1001, 10 << 20, 20 << 20] {
        let notices = "\"\",".repeat(count);
        let written =
            format!(r#"{{"version":1,"pid":1,"host":"h","notices":[{notices}""],"projects":[]}}"#);
        fs::write(&status, written).unwrap();
        let output = viewrank(&["status", root_path]).output().unwrap();
        assert!(
            output.stdout.len() + output.stderr.len() < 10_000,
            "{count}"
        );
        assert!(
            matches!(output.status.code(), Some(0..=2)),
            "{}",
            output.status
        );
    }
}

#[test]
fn a_plan_of_any_contents_is_read_in_little_memory_or_refused() {
    let root = Root::new(&["p"]);
    let project = root.project("p");
    succeeds(viewrank(&["plan", text(&project)]));
    let manifest = project.join("viewrank/manifest.json");
    let written: Value = serde_json::from_slice(&fs::read(&manifest).unwrap()).unwrap();
    let export = || {
        let arguments = ["export", text(&project), "--backend", "gipuma"];
        viewrank_within(1 << 20, &arguments).output().unwrap()
    };
    let bytes = 56 << 20;
    let names = |bytes| format!("[{}\"a\"]", "\"a\",".repeat(bytes / 4));
    let outdated = r#"{"key":"a","view":"b"},"#;
    let outdated = format!("[{}{}]", outdated.repeat(bytes / 23), &outdated[..22]);
    let record = serde_json::json!({ "backend": "gipuma", "not_honoured": [], "warnings": "@" });
    let partners = "/clusters/0/partners";
    for (place, value, planted, why) in [
        (partners, "@".into(), names(bytes), "cut.pairs"),
        (partners, "@".into(), names(129 << 20), "limit for a plan"),
        ("/outdated", "@".into(), outdated, "more than 262144"),
        (
            "/exports",
            Value::from([record]),
            names(bytes),
            "more than 10000",
        ),
        (
            "/backend",
            "@".into(),
            format!("\"{}\"", "A".repeat(bytes)),
            "A ... A",
        ),
    ] {
        let mut manifest_now = written.clone();
        *manifest_now.pointer_mut(place).unwrap() = value;
        fs::write(
            &manifest,
            manifest_now.to_string().replace("\"@\"", &planted),
        )
        .unwrap();
        let output = export();
        assert_eq!(output.status.code(), Some(1), "{place}: {}", output.status);
        let error = said(&output);
        assert!(error.contains(why), "{place}: {error}");
        assert!(error.len() < 2000, "{place}");
    }
}

#[test]
fn settings_are_refused_by_line_whatever_is_in_them() {
    let root = Root::new(&["p"]);
    let file = root.project("p").join("viewrank.toml");
    let inspect = || fails(viewrank(&["config", text(&root.project("p"))]));
    let keys: String = (0..1_000_000 / 10)
        .map(|i| format!("a{i:06}=\"\"\n"))
        .collect::<String>();
    fs::write(&file, &keys[..1_000_000]).unwrap();
    assert!(inspect().contains("viewrank.toml"));
    fs::write(&file, format!("\n\n{} = 1\n", "a.".repeat(500_000) + "a")).unwrap();
    assert!(inspect().contains("viewrank.toml"));
    fs::write(&file, format!("\n\nk = {}", "[".repeat(1_000_000))).unwrap();
    assert!(inspect().contains("viewrank.toml:3"));
    fs::write(&file, format!("{} = 1\n", "a".repeat(1_000_000))).unwrap();
    assert!(inspect().contains("unknown setting"));
}

/// A daemon that is ended when dropped.
struct Daemon(Child);

impl Drop for Daemon {
    fn drop(&mut self) {
        _ = self.0.kill();
        _ = self.0.wait();
    }
}

impl Daemon {
    /// Waits for a worker: the first child of the daemon.
    fn worker(&self) -> u32 {
        let threads = format!("/proc/{}/task", self.0.id());
        let child = |thread: fs::DirEntry| {
            let children = fs::read_to_string(thread.path().join("children")).ok()?;
            children.split_whitespace().next()?.parse().ok()
        };
        eventually(|| {
            fs::read_dir(&threads)
                .ok()?
                .filter_map(|thread| child(thread.ok()?))
                .next()
        })
    }
}

#[track_caller]
fn eventually<T>(mut look: impl FnMut() -> Option<T>) -> T {
    let end = Instant::now() + Duration::from_secs(120);
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(Instant::now() < end, "it did not happen");
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[test]
fn a_plan_that_is_killed_sets_its_project_aside_and_others_go_on() {
    let root = Root::new(&["p"]);
    let daemon = Daemon(root.watch(&[]).stderr(Stdio::null()).spawn().unwrap());
    let worker = daemon.worker();
    assert!(
        Command::new("kill")
            .args(["-KILL", &worker.to_string()])
            .status()
            .unwrap()
            .success()
    );
    let failed = eventually(|| {
        root.state_of("p")
            .filter(|found| found["state"] == "failed")
    });
    assert!(
        failed["reason"].as_str().unwrap().contains("signal: 9"),
        "{failed}"
    );
    assert_eq!(failed["retry_after_s"], 3600);
    let added = Root::new(&["q"]);
    fs::rename(added.project("q"), root.project("q")).unwrap();
    eventually(|| {
        root.state_of("q")
            .filter(|found| found["state"] == "planned")
    });
    assert_eq!(root.state_of("p").unwrap()["state"], "failed");
    // Its input changes.
    fs::write(root.project("p").join("viewrank.toml"), "").unwrap();
    eventually(|| {
        root.state_of("p")
            .filter(|found| found["state"] == "planned")
    });
}

#[test]
fn workers_end_with_the_daemon_however_it_ends() {
    let root = Root::new(&["p"]);
    let mut daemon = Daemon(root.watch(&[]).stderr(Stdio::null()).spawn().unwrap());
    let worker = PathBuf::from(format!("/proc/{}", daemon.worker()));
    daemon.0.kill().unwrap();
    eventually(|| (!worker.exists()).then_some(()));
    drop(daemon);
    succeeds(root.watch(&["--once"]));
    assert_eq!(root.state_of("p").unwrap()["state"], "planned");
}
