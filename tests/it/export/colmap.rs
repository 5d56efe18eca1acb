//! COLMAP's dense workspace: what the programs would do with it, played through.

use std::collections::{BTreeMap, BTreeSet};

use viewrank::backends::{BackendError, ExportOptions, References};
use viewrank_core::model::cluster::MapScale;

use super::{Files, Fixture};

/// The problems that patch match reads from a list: pairs of lines; `#` comments and empty lines
/// vanish.
fn problems(text: &str) -> Vec<(String, Vec<String>)> {
    let lines: Vec<&str> = text
        .lines()
        .map(str::trim)
        .filter(|l| !l.is_empty() && !l.starts_with('#'))
        .collect();
    assert_eq!(
        lines.len() % 2,
        0,
        "a reference without sources would be dropped silently"
    );
    let sources = |line: &str| {
        line.split([',', ';'])
            .map(|s| s.trim().to_owned())
            .filter(|s| !s.is_empty())
            .collect()
    };
    lines
        .chunks(2)
        .map(|pair| (pair[0].to_owned(), sources(pair[1])))
        .collect()
}

/// What is in the workspace while COLMAP runs: photometric maps (filtered or not) and geometric
/// ones.
#[derive(Default)]
struct Workspace {
    photometric: BTreeMap<String, bool>,
    geometric: BTreeSet<String>,
}

impl Workspace {
    /// The commands of the runner, one after the other, as patch_match.cc works them off.
    fn run(files: &Files) -> Self {
        let mut workspace = Self::default();
        for command in &files.0.record.commands {
            let words: Vec<&str> = command.split_whitespace().collect();
            let value = |option: &str| {
                words
                    .iter()
                    .position(|w| *w == option)
                    .map(|i| words[i + 1])
            };
            match words[1] {
                "patch_match_stereo" => {
                    let list = problems(files.text(value("--config_path").unwrap()));
                    let filtered = value("--PatchMatchStereo.filter") != Some("0");
                    workspace.patch_match(
                        &list,
                        value("--PatchMatchStereo.geom_consistency") != Some("0"),
                        filtered,
                    );
                }
                "stereo_fusion" => workspace.fuse(files, value("--input_type").unwrap()),
                other => panic!("{other}"),
            }
        }
        workspace
    }

    fn patch_match(&mut self, list: &[(String, Vec<String>)], geometric: bool, filtered: bool) {
        for (reference, sources) in list {
            assert!(!sources.is_empty(), "{reference}: COLMAP ends the run");
            self.photometric
                .entry(reference.clone())
                .or_insert(filtered && !geometric);
        }
        if geometric {
            for (reference, sources) in list {
                for source in sources.iter().chain([reference]) {
                    let filtered = self.photometric.get(source);
                    assert_eq!(
                        filtered,
                        Some(&false),
                        "{reference} needs the unfiltered photometric map of {source}"
                    );
                }
                self.geometric.insert(reference.clone());
            }
        }
    }

    fn fuse(&self, files: &Files, kind: &str) {
        for name in files.lines("stereo/fusion.cfg") {
            assert!(
                if kind == "geometric" {
                    self.geometric.contains(name)
                } else {
                    self.photometric.contains_key(name)
                },
                "{name}"
            );
        }
    }
}

fn options(refs: Option<References>, geometric: Option<bool>) -> ExportOptions {
    ExportOptions {
        refs,
        geometric,
        ..Default::default()
    }
}

fn policies() -> Vec<ExportOptions> {
    let refs = [
        None,
        Some(References::Keys),
        Some(References::KeysAndPartners),
        Some(References::All),
    ];
    let geometric = [None, Some(false), Some(true)];
    refs.into_iter()
        .flat_map(|r| geometric.map(|g| options(r, g)))
        .collect()
}

#[test]
fn colmap_geometric_needs_partner_maps() {
    let fixture = Fixture::new(4);
    for policy in policies() {
        let files = fixture.export_with("colmap", &policy);
        let workspace = Workspace::run(&files);
        let refs = policy.refs.unwrap_or(if policy.geometric == Some(true) {
            References::KeysAndPartners
        } else {
            References::Keys
        });
        let partners = fixture
            .named()
            .iter()
            .flat_map(|(k, p)| [vec![k.clone()], p.clone()].concat())
            .collect::<BTreeSet<_>>();
        let maps = workspace.photometric.len();
        match refs {
            References::Keys if policy.geometric == Some(true) => assert!(maps <= 4),
            References::Keys => assert_eq!(maps, 4),
            References::KeysAndPartners => assert_eq!(maps, partners.len()),
            References::All => assert_eq!(maps, fixture.matchable().len()),
        }
        assert_eq!(
            files.0.record.key_maps + files.0.record.other_maps,
            maps,
            "{policy:?}"
        );
    }
}

/// Also without our runner: the list that lies where COLMAP looks for it, with the options at its
/// head.
#[test]
fn the_list_in_place_runs_through() {
    let mut fixture = Fixture::new(4);
    fixture.choose(&[12, 13, 11, 3], 4);
    for policy in policies() {
        let files = fixture.export_with("colmap", &policy);
        let text = files.text("stereo/patch-match.cfg");
        let geometric = text.contains("geom_consistency 1");
        let mut workspace = Workspace::default();
        workspace.patch_match(&problems(text), geometric, true);
    }
}

#[test]
fn keys_are_first_in_rank_order_with_exactly_their_partners() {
    let fixture = Fixture::new(4);
    for refs in [
        References::Keys,
        References::KeysAndPartners,
        References::All,
    ] {
        let files = fixture.export_with("colmap", &options(Some(refs), None));
        assert_eq!(
            problems(files.text("stereo/patch-match.cfg"))[..4],
            fixture.named()[..],
            "{refs:?}"
        );
    }
    assert_eq!(
        problems(fixture.export("colmap").text("stereo/patch-match.cfg")),
        fixture.named()
    );
}

#[test]
fn colmap_min_consistent_before_drop() {
    let mut fixture = Fixture::new(4);
    let neighbours: Vec<u32> = fixture
        .connected(viewrank_core::model::scene::ViewIndex(12))
        .iter()
        .take(2)
        .map(|v| v.0)
        .collect();
    fixture.choose(&[12, neighbours[0], neighbours[1], 49], 4);
    let files = fixture.export_with("colmap", &options(Some(References::Keys), Some(true)));
    // No source without a map, so that COLMAP drops none after it has bounded the number of
    // consistent ones.
    let last = problems(files.text("stereo/viewrank/0001-geometric.cfg"));
    let keys: BTreeSet<String> = fixture.named().into_iter().map(|(key, _)| key).collect();
    assert!(
        !last.is_empty()
            && last
                .iter()
                .all(|(_, sources)| sources.iter().all(|s| keys.contains(s)))
    );
    let lonely = fixture
        .named()
        .into_iter()
        .find(|(_, p)| p.iter().all(|p| !keys.contains(p)))
        .unwrap()
        .0;
    assert!(
        files.says(&lonely),
        "a key view without geometric map is named"
    );
}

/// COLMAP makes no folders.
#[test]
fn each_map_of_either_pass_has_a_folder() {
    let mut fixture = Fixture::new(4);
    // No partner of the last, in a sub-folder of its own, is a key view: it has no geometric map.
    fixture.choose(&[12, 13, 49], 4);
    for policy in policies() {
        let files = fixture.export_with("colmap", &policy);
        let is_list = |name: &&str| name.ends_with(".cfg") && *name != "stereo/fusion.cfg";
        for list in files.names().into_iter().filter(is_list) {
            for (reference, _) in problems(files.text(list)) {
                let folder = reference.rsplit_once('/').unwrap().0;
                let maps = format!("stereo/depth_maps/{folder}");
                assert!(files.is_folder(&maps), "{maps} of {list}, {policy:?}");
            }
        }
    }
}

#[test]
fn batches_leave_whole_results() {
    let mut fixture = Fixture::new(3);
    fixture.choose(&(0..25).collect::<Vec<_>>(), 3);
    let files = fixture.export_with("colmap", &options(None, Some(true)));
    let geometric: Vec<_> = files
        .names()
        .into_iter()
        .filter(|n| n.ends_with("-geometric.cfg"))
        .map(str::to_owned)
        .collect();
    assert_eq!(geometric.len(), 3);
    let order: Vec<_> = geometric
        .iter()
        .flat_map(|name| problems(files.text(name)))
        .collect();
    assert_eq!(order, fixture.named());
    Workspace::run(&files);
}

#[test]
fn colmap_fusion_min_pixels() {
    let mut fixture = Fixture::new(3);
    fixture.choose(&[12, 13, 11], 3);
    let command = fixture.export("colmap").0.record.commands.pop().unwrap();
    assert!(
        command.contains("--StereoFusion.min_num_pixels 2 "),
        "three key views with COLMAP's 5 give an empty cloud: {command}"
    );
}

#[test]
fn colmap_check_num_images_before_filter() {
    let fixture = Fixture::new(3);
    let command = fixture.export("colmap").0.record.commands.pop().unwrap();
    assert!(command.contains(&format!(
        "--StereoFusion.check_num_images {}",
        fixture.scene.views.len()
    )));
}

#[test]
fn colmap_fusion_cfg_no_comments() {
    let fixture = Fixture::new(3);
    let names: Vec<String> = fixture.named().into_iter().map(|(key, _)| key).collect();
    assert_eq!(fixture.export("colmap").lines("stereo/fusion.cfg"), names);
}

#[test]
fn colmap_text_model_blank_name() {
    let files = Fixture::new(3).export("colmap");
    assert!(
        files.names().contains(&"sparse/images.bin"),
        "text models cut names at blanks"
    );
    let name = b"flight 0/img 012.jpg\0";
    assert!(
        files
            .bytes("sparse/images.bin")
            .windows(name.len())
            .any(|w| w == name)
    );
}

#[test]
fn colmap_bin_beats_txt() {
    let files = Fixture::new(3).export("colmap");
    assert!(
        !files
            .names()
            .iter()
            .any(|n| n.starts_with("sparse/") && n.ends_with(".txt"))
    );
}

#[test]
fn colmap_stale_rigs_frames() {
    let files = Fixture::new(3).export("colmap");
    let model: Vec<_> = files
        .names()
        .into_iter()
        .filter(|n| n.starts_with("sparse/"))
        .map(str::to_owned)
        .collect();
    assert_eq!(
        model,
        [
            "sparse/cameras.bin",
            "sparse/images.bin",
            "sparse/points3D.bin"
        ]
    );
}

#[test]
fn colmap_key_view_without_points() {
    let mut fixture = Fixture::new(3);
    let blind = fixture.clusters[1].key;
    let kept: Vec<bool> = fixture
        .scene
        .track_views
        .iter()
        .map(|v| *v != blind)
        .collect();
    let before = |end: usize| kept[..end].iter().filter(|k| **k).count();
    fixture.scene.track_offsets = fixture
        .scene
        .track_offsets
        .iter()
        .map(|&o| before(o))
        .collect();
    let mut keep = kept.iter();
    fixture.scene.track_views.retain(|_| *keep.next().unwrap());
    let mut keep = kept.iter();
    fixture.scene.track_pixels.retain(|_| *keep.next().unwrap());
    for policy in policies() {
        let files = fixture.export_with("colmap", &policy);
        let references: Vec<String> = problems(files.text("stereo/patch-match.cfg"))
            .into_iter()
            .map(|(r, _)| r)
            .collect();
        assert!(
            !references.iter().any(|r| r == fixture.name(blind)),
            "it would end the whole run"
        );
        assert!(files.says(fixture.name(blind)));
    }
}

#[test]
fn colmap_subfolder_dirs() {
    let mut fixture = Fixture::new(3);
    let matchable = fixture.matchable();
    fixture.choose(&[matchable[0].0, matchable[matchable.len() - 1].0], 3);
    let keys: BTreeSet<String> = fixture.named().into_iter().map(|(key, _)| key).collect();
    let folders: BTreeSet<&str> = keys
        .iter()
        .map(|key| key.rsplit_once('/').unwrap().0)
        .collect();
    assert_eq!(
        folders.len(),
        2,
        "the first and the last view lie in different folders"
    );
    let files = fixture.export("colmap");
    for kind in ["depth_maps", "normal_maps", "consistency_graphs"] {
        for folder in &folders {
            assert!(
                files.is_folder(&format!("stereo/{kind}/{folder}")),
                "{kind} {folder}"
            );
        }
    }
}

#[test]
fn matched_size_is_that_of_the_plan() {
    let mut fixture = Fixture::new(3);
    assert!(!fixture.export("colmap").0.record.commands[0].contains("max_image_size"));
    fixture.image_scale = 0.5;
    assert!(
        fixture.export("colmap").0.record.commands[0]
            .contains("--PatchMatchStereo.max_image_size 320")
    );
}

#[test]
fn key_views_at_half_the_size_are_computed_in_their_turn_at_that_size() {
    let mut fixture = Fixture::new(3);
    fixture.clusters[1].scale = MapScale::Half;
    fixture.clusters[2].scale = MapScale::Half;
    let files = fixture.export("colmap");
    let commands = &files.0.record.commands;
    let size = |command: &String| {
        command
            .split_once("max_image_size ")
            .map(|(_, size)| size.to_owned())
    };
    assert_eq!(
        commands[..3].iter().map(size).collect::<Vec<_>>(),
        [None, Some("320".into()), None]
    );
    let lists =
        ["0001", "0002", "0003"].map(|n| problems(files.text(&format!("stereo/viewrank/{n}.cfg"))));
    assert_eq!(lists.concat(), fixture.named(), "in rank order");
    assert_eq!(
        problems(files.text("stereo/patch-match.cfg")),
        fixture.named()
    );
    let run: serde_json::Value =
        serde_json::from_str(files.text("stereo/viewrank/run.json")).unwrap();
    let sizes = (0..3).map(|i| run["maps"][i]["max_image_size"].as_u64());
    assert_eq!(sizes.collect::<Vec<_>>(), [None, Some(320), Some(320)]);
    assert!(
        files
            .0
            .record
            .not_honoured
            .iter()
            .all(|what| !what.contains("half"))
    );
    Workspace::run(&files);
    let geometric = fixture.export_with("colmap", &options(None, Some(true)));
    assert!(geometric.says("2 key views that are planned at half the size"));
}

#[test]
fn colmap_name_of_a_view_that_only_refs_all_lists() {
    let mut fixture = Fixture::new(3);
    let all = ExportOptions {
        refs: Some(References::All),
        ..Default::default()
    };
    let listed: BTreeSet<String> = fixture
        .named()
        .into_iter()
        .flat_map(|(k, p)| [vec![k], p].concat())
        .collect();
    let other = fixture
        .matchable()
        .into_iter()
        .find(|v| !listed.contains(fixture.name(*v)))
        .unwrap();
    fixture.scene.views[other.index()].name = "a,b.jpg".into();
    assert!(
        fixture
            .try_export("colmap", &ExportOptions::default())
            .is_ok()
    );
    assert!(matches!(
        fixture.try_export("colmap", &all),
        Err(BackendError::Name { .. })
    ));
}

#[test]
fn colmap_fusion_min_pixels_of_a_single_map() {
    let mut fixture = Fixture::new(3);
    fixture.clusters.truncate(1);
    let command = fixture.export("colmap").0.record.commands.pop().unwrap();
    assert!(
        command.contains("--StereoFusion.min_num_pixels 1 "),
        "{command}"
    );
    assert!(
        command.ends_with("--output_path stereo/viewrank/fused.ply"),
        "fused.ply itself may be the user's"
    );
}
