//! Which depth maps count for a plan: those of its program that were made for it, in whatever order
//! plan and maps came, and the same for `status`, `plan` and `watch`.

use serde_json::Value;

use super::{
    undistorted::{distorted, workspace},
    *,
};

impl Folder {
    fn json(&self, name: &str) -> Value {
        serde_json::from_slice(&fs::read(self.at(name)).unwrap()).unwrap()
    }

    /// Depth maps as COLMAP's with this suffix: a plane.
    fn maps_of_colmap(&self, workspace: &str, views: &[String]) -> &Self {
        for (kind, channels) in [("depth_maps", 1), ("normal_maps", 3)] {
            let mut bytes = format!("100&75&{channels}&").into_bytes();
            bytes.extend((0..100 * 75 * channels).flat_map(|_| 40_f32.to_le_bytes()));
            for view in views {
                let name = format!("{workspace}/stereo/{kind}/{view}.photometric.bin");
                self.write(&name, &bytes);
            }
        }
        self
    }

    /// The marks of all listed maps, as `run.sh` writes them.
    fn marks(&self, workspace: &str) {
        let own = format!("{workspace}/stereo/viewrank");
        let list = fs::read_to_string(self.at(&format!("{own}/marks.tsv"))).unwrap();
        for line in list.lines() {
            let mut cells = line.split('\t');
            let mark = format!("{own}/done/{}", cells.next().unwrap());
            self.write(&mark, format!("{}\n", cells.next().unwrap()));
        }
    }

    /// A depth map where sgm has its own, with its mark.
    fn map_of_sgm(&self, project: &str, key: &str) {
        self.write(&format!("{project}/sgm/depth_maps/{key}.npy"), npy());
        let own = format!("{project}/viewrank/sgm");
        let list = fs::read_to_string(self.at(&format!("{own}/marks.tsv"))).unwrap();
        let of_key = |line: &&str| line.ends_with(&format!("/depth_maps/{key}.npy"));
        let cells: Vec<&str> = list.lines().find(of_key).unwrap().split('\t').collect();
        self.write(&format!("{own}/done/{}", cells[0]), cells[1]);
    }

    fn status(&self, project: &str) -> Value {
        let path = self.at(project);
        let path = path.to_str().unwrap();
        let (code, stdout, stderr) = said(&viewrank(&["status", path, "--json"]));
        assert_eq!(code, 0, "{stderr}");
        let status: Value = serde_json::from_str(&stdout).unwrap();
        status["projects"][0].clone()
    }

    fn finished(&self, project: &str) -> usize {
        let manifest = self.json(&format!("{project}/viewrank/manifest.json"));
        let clusters = manifest["clusters"].as_array().unwrap();
        clusters.iter().filter(|c| c["finished"] == true).count()
    }
}

fn views() -> Vec<String> {
    names(&scene()).into_iter().map(str::to_owned).collect()
}

fn plan(folder: &Folder, project: &str, options: &[&str]) {
    let path = folder.at(project);
    let path = path.to_str().unwrap();
    let arguments = ["plan", path, "--confidence", "geometric"];
    let (code, _, stderr) = said(&viewrank(&[&arguments, options].concat()));
    assert_eq!(code, 0, "{stderr}");
}

fn npy() -> Vec<u8> {
    let head =
        b"\x93NUMPY\x01\x00\x76\x00{'descr': '<f4', 'fortran_order': False, 'shape': (75, 100), }";
    let mut bytes = head.to_vec();
    bytes.resize(127, b' ');
    bytes.push(b'\n');
    bytes.extend((0..75 * 100).flat_map(|_| 40_f32.to_le_bytes()));
    bytes
}

#[test]
fn the_status_is_that_of_the_plan_whose_maps_are_computed() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &distorted())
        .pictures(&scene(), |name| format!("images/{name}"));
    // Before there are undistorted images, the plan is in the project itself.
    let options = ["--backend", "sgm", "--budget", "3"];
    assert_eq!(folder.plan(&options).0, 1);
    let root = folder.path().to_str().unwrap();
    assert!(viewrank(&["undistort", root]).status.success());
    let (code, _, stderr) = folder.plan(&options);
    assert_eq!(code, 0, "{stderr}");
    assert!(folder.at("viewrank/manifest.json").is_file());
    let manifest = folder.json("dense/viewrank/manifest.json");
    let key = manifest["clusters"][0]["key"].as_str().unwrap();
    folder.map_of_sgm("dense", key);
    let status = folder.status(".");
    assert_eq!(
        (&status["done"], &status["clusters"]),
        (&1.into(), &3.into())
    );
    // A program that takes distorted images is planned in the project.
    assert_eq!(folder.plan(&["--backend", "odm", "--budget", "4"]).0, 0);
    assert_eq!(folder.status(".")["backend"], "odm");
}

#[test]
fn maps_in_a_workspace_below_do_not_count_for_the_plan_of_the_distorted_model() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &distorted())
        .pictures(&scene(), |name| format!("images/{name}"));
    assert_eq!(folder.plan(&["--backend", "colmap", "--budget", "3"]).0, 1);
    workspace(&folder, "dense", &ColmapModel::from_scene(&scene()));
    folder.maps_of_colmap("dense", &views());
    let status = folder.status(".");
    assert_eq!(status["state"], "planned", "{status}");
    let note = status["note"].as_str().unwrap();
    assert!(
        note.contains("9 depth maps") && note.contains("not counted"),
        "{note}"
    );
    let root = folder.path().to_str().unwrap();
    let (_, stdout, _) = said(&viewrank(&["status", root]));
    assert!(
        stdout.contains("0 of 3") && stdout.contains("not counted"),
        "{stdout}"
    );
}

#[test]
fn the_users_own_maps_of_colmap_count_only_where_he_says_so_in_whatever_order() {
    for maps_first in [true, false] {
        let folder = Folder::new();
        workspace(&folder, "p", &ColmapModel::from_scene(&scene()));
        let options = ["--backend", "colmap", "--budget", "3"];
        if maps_first {
            folder.maps_of_colmap("p", &views());
        }
        plan(&folder, "p", &options);
        folder.maps_of_colmap("p", &views());
        let root = folder.path().to_str().unwrap();
        let checks = || {
            assert_eq!(folder.finished("p"), 0, "maps first: {maps_first}");
            assert_eq!(folder.status("p")["state"], "planned");
        };
        checks();
        plan(&folder, "p", &options);
        checks();
        folder.write("p/viewrank.toml", "backends = ['colmap']\ncut.budget = 3\n");
        assert!(viewrank(&["watch", root, "--once"]).status.success());
        fs::remove_file(folder.at("viewrank/status.json")).unwrap();
        checks();

        let own = folder.at("p/stereo/depth_maps");
        let finished = ["--finished", own.to_str().unwrap()];
        plan(&folder, "p", &[&options[..], &finished].concat());
        assert_eq!(folder.finished("p"), 9);
        // What a plan counts, the next one counts, too.
        plan(&folder, "p", &options);
        assert_eq!(folder.finished("p"), 9);
        assert_eq!(folder.status("p")["done"], 9);
    }
}

#[test]
fn maps_of_colmap_with_the_marks_of_the_lists_count() {
    let folder = Folder::new();
    workspace(&folder, "p", &ColmapModel::from_scene(&scene()));
    let options = ["--backend", "colmap", "--budget", "3"];
    plan(&folder, "p", &options);
    folder.maps_of_colmap("p", &views());
    folder.marks("p");
    assert_eq!(folder.status("p")["done"], 3);
    // The user's own, which COLMAP makes by default, hide none of them.
    for view in views() {
        folder.write(
            &format!("p/stereo/depth_maps/{view}.geometric.bin"),
            b"2&2&1&of another size",
        );
    }
    assert_eq!(folder.status("p")["done"], 3);
    plan(&folder, "p", &options);
    assert_eq!(folder.finished("p"), 3);
    // Maps that were made from something else.
    for mark in fs::read_dir(folder.at("p/stereo/viewrank/done")).unwrap() {
        fs::write(mark.unwrap().path(), "0123456789abcdef\n").unwrap();
    }
    let none = folder.write("none/readme", "").at("none");
    let none = ["--finished", none.to_str().unwrap()];
    plan(&folder, "p", &[&options[..], &none].concat());
    assert_eq!(folder.status("p")["state"], "planned");
}

#[test]
fn the_maps_of_another_program_are_named_and_do_not_count() {
    let folder = Folder::new();
    folder
        .colmap("p/sparse/0", &ColmapModel::from_scene(&scene()))
        .pictures(&scene(), |name| format!("p/images/{name}"))
        .write("p/viewrank.toml", "backends = ['openmvs']\n");
    plan(&folder, "p", &[]);
    folder.write("p/sgm/depth_maps/view_0.png.npy", npy());
    let status = folder.status("p");
    assert_eq!(status["state"], "planned", "{status}");
    let note = status["note"].as_str().unwrap();
    assert!(
        note.contains("sgm") && note.contains("another program"),
        "{note}"
    );
    let project = folder.at("p");
    let (code, _, stderr) = said(&viewrank(&["report", project.to_str().unwrap()]));
    assert_eq!(code, 0, "{stderr}");
    let page = fs::read_to_string(folder.at("p/viewrank/report.html")).unwrap();
    assert!(page.contains("of another program than the plan, and do not count"));
    assert!(
        page.contains("\"real\":null"),
        "nothing is measured of its own"
    );
    let root = folder.path().to_str().unwrap();
    let watched = viewrank(&["watch", root, "--once"]);
    assert!(watched.status.success(), "{watched:?}");
    assert_eq!(folder.status("p")["state"], "planned");
    assert!(!folder.at("p/viewrank/progress.json").exists());
}

#[test]
fn the_maps_of_another_program_are_not_finished_ones_of_a_plan() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &ColmapModel::from_scene(&scene()))
        .pictures(&scene(), |name| format!("images/{name}"));
    let options = ["--backend", "openmvs", "--budget", "3"];
    plan(&folder, ".", &options);
    for view in views() {
        folder.write(&format!("sgm/depth_maps/{view}.npy"), npy());
        folder.write(&format!("own/{view}.npy"), npy());
    }
    let finished = |name: &str| {
        let maps = folder.at(name).display().to_string();
        let (code, _, stderr) = folder.plan(&[&options[..], &["--finished", &maps]].concat());
        assert_eq!(code, 0, "{stderr}");
        (
            folder.finished("."),
            stderr.contains("9 depth maps in") && stderr.contains("another program"),
        )
    };
    assert_eq!(finished("sgm"), (0, true));
    assert_eq!(finished("own"), (9, false));
}

#[test]
fn maps_without_marks_count_no_more_in_the_status_than_in_a_run() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &ColmapModel::from_scene(&scene()))
        .pictures(&scene(), |name| format!("images/{name}"));
    plan(&folder, ".", &["--backend", "sgm", "--budget", "3"]);
    for view in views() {
        folder.write(&format!("sgm/depth_maps/{view}.npy"), npy());
    }
    let status = folder.status(".");
    assert_eq!(status["state"], "planned", "{status}");
    assert!(
        status["note"].to_string().contains("9 depth maps"),
        "{status}"
    );
    let manifest = folder.json("viewrank/manifest.json");
    let key = manifest["clusters"][1]["key"].as_str().unwrap().to_owned();
    folder.map_of_sgm(".", &key);
    assert_eq!(folder.status(".")["done"], 1);
}

#[test]
fn a_part_of_a_project_has_the_status_of_the_project() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &ColmapModel::from_scene(&scene()))
        .pictures(&scene(), |name| format!("images/{name}"));
    plan(&folder, ".", &["--backend", "openmvs", "--budget", "3"]);
    let whole = folder.status(".");
    assert_eq!(whole["clusters"], 3, "{whole}");
    for part in ["viewrank", "viewrank/manifest.json", "sparse/0", "images"] {
        assert_eq!(folder.status(part)["clusters"], 3, "{part}");
    }
}

#[test]
fn finished_maps_elsewhere_count_once_they_are_where_the_program_writes_them() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &ColmapModel::from_scene(&scene()))
        .pictures(&scene(), |name| format!("images/{name}"));
    let options = ["--backend", "sgm", "--budget", "3"];
    plan(&folder, ".", &options);
    let manifest = folder.json("viewrank/manifest.json");
    let key = manifest["clusters"][0]["key"].as_str().unwrap().to_owned();
    folder.write(&format!("elsewhere/{key}.npy"), npy());
    let elsewhere = folder.at("elsewhere").display().to_string();
    let finished = [&options[..], &["--finished", &elsewhere]].concat();
    let (code, _, stderr) = folder.plan(&finished);
    assert_eq!((code, folder.finished(".")), (0, 1), "{stderr}");
    assert!(
        stderr.contains("copy 1 finished depth map there"),
        "{stderr}"
    );
    let status = folder.status(".");
    let note = status["note"].as_str().unwrap_or_default();
    assert!(note.contains("put it where sgm writes its own"), "{status}");
    folder.write(&format!("sgm/depth_maps/{key}.npy"), npy());
    let status = folder.status(".");
    assert_eq!(status["done"], 1, "{status}");
    assert!(!status.to_string().contains("writes its own"), "{status}");
}

#[test]
fn a_map_of_full_size_counts_where_half_is_planned() {
    let folder = Folder::new();
    workspace(&folder, ".", &ColmapModel::from_scene(&scene()));
    plan(&folder, ".", &["--backend", "colmap", "--budget", "3"]);
    let list = fs::read_to_string(folder.at("stereo/viewrank/marks.tsv")).unwrap();
    let cells: Vec<&str> = list.lines().next().unwrap().split('\t').collect();
    let view = cells[2].strip_suffix(".photometric.bin").unwrap();
    folder.maps_of_colmap(".", &[view.to_owned()]);
    let mut run = folder.json("stereo/viewrank/run.json");
    let row = run["maps"].as_array_mut().unwrap();
    let row = row
        .iter_mut()
        .find(|row| row["problem"]["reference"] == view);
    row.unwrap()["id_at_full_size"] = "00ff".into();
    folder.write("stereo/viewrank/run.json", run.to_string());
    let maps = folder.at("stereo/depth_maps");
    let counts = |id: &str| {
        folder.write(&format!("stereo/viewrank/done/{}", cells[0]), id);
        viewrank::backends::known_maps("colmap", &maps)(&maps.join(cells[2]))
    };
    assert_eq!(["00fe", "00ff", cells[1]].map(counts), [false, true, true]);
}
