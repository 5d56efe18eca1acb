//! Gipuma, MicMac, AliceVision, Metashape, RealityScan.

use std::collections::{BTreeMap, BTreeSet};

use quick_xml::events::Event;
use serde_json::Value;
use viewrank::backends::{BackendError, ExportOptions};
use viewrank_core::model::{cluster::MapScale, scene::ViewIndex};

use super::{Fixture, numbers, table};

// Gipuma

#[test]
fn gipuma_first_is_key() {
    let fixture = Fixture::new(3);
    let files = fixture.export("gipuma");
    let names: BTreeMap<String, String> = files
        .lines("view_names.txt")
        .iter()
        .map(|l| l.split_once('\t').unwrap())
        .map(|(i, n)| (i.into(), n.into()))
        .collect();
    for (command, (key, partners)) in files.0.record.commands.iter().zip(fixture.named()) {
        let images: Vec<&str> = command
            .split(' ')
            .skip(1)
            .take_while(|w| !w.starts_with('-'))
            .collect();
        let named: Vec<String> = images.iter().map(|i| names[*i].clone()).collect();
        assert_eq!(named, [vec![key], partners].concat());
    }
}

#[test]
fn gipuma_no_view_selection() {
    assert!(
        !Fixture::new(3)
            .export("gipuma")
            .text("run.sh")
            .contains("view_selection"),
        "it would choose at random"
    );
}

#[test]
fn gipuma_depth_range_mandatory() {
    for command in Fixture::new(3).export("gipuma").0.record.commands {
        let value = |key: &str| -> f64 {
            command
                .split(key)
                .nth(1)
                .unwrap()
                .split(' ')
                .next()
                .unwrap()
                .parse()
                .unwrap()
        };
        assert!(0.0 < value("--depth_min=") && value("--depth_min=") < value("--depth_max="));
    }
}

/// fusibile wants two other views by default, which few places have where only key views have maps.
#[test]
fn gipuma_fusibile_num_consistent() {
    let record = Fixture::new(3).export("gipuma").0.record;
    assert!(
        record.fusion.contains(" --num_consistent=1"),
        "{}",
        record.fusion
    );
}

#[test]
fn gipuma_four_letter_extension() {
    let mut fixture = Fixture::new(3);
    fixture
        .scene
        .views
        .iter_mut()
        .for_each(|v| v.name = v.name.replace(".jpg", ".jpeg"));
    let files = fixture.export("gipuma");
    let images: Vec<&str> = files
        .names()
        .into_iter()
        .filter(|n| n.starts_with("images/"))
        .collect();
    assert!(
        !images.is_empty()
            && images
                .iter()
                .all(|n| n.len() == "images/00000000.jpg".len())
    );
    let matrix = images[0].replacen("images", "p", 1) + ".P";
    assert_eq!(numbers(files.text(&matrix)).len(), 12);
}

// MicMac

fn plain_names() -> Fixture {
    let mut fixture = Fixture::new(3);
    for (i, view) in fixture.scene.views.iter_mut().enumerate() {
        view.name = format!("img_{i:03}.jpg");
    }
    fixture
}

/// Texts of the elements of that name, by a real XML parser.
fn texts(xml: &str, element: &str) -> Vec<String> {
    let mut reader = quick_xml::Reader::from_str(xml);
    let (mut inside, mut found) = (false, Vec::new());
    loop {
        match reader.read_event().unwrap() {
            Event::Start(start) if start.name().as_ref() == element => {
                inside = true;
                found.push(String::new());
            }
            Event::End(end) if end.name().as_ref() == element => inside = false,
            Event::Text(text) if inside => found.last_mut().unwrap().push_str(&text),
            Event::GeneralRef(entity) if inside => {
                assert_eq!(&*entity, "amp");
                found.last_mut().unwrap().push('&');
            }
            Event::Eof => return found,
            _ => {}
        }
    }
}

#[test]
fn micmac_blank_in_name() {
    let fixture = Fixture::new(3);
    let error = fixture
        .try_export("micmac", &ExportOptions::default())
        .err()
        .unwrap();
    assert!(error.to_string().contains("flight"), "{error}");
}

/// Malt takes the pattern of images for the name of the master, and puts it into a command without
/// quotes: `img\.jpg +FileIm1=...` would reach MicMac as one word.
#[test]
fn micmac_pattern_is_the_masters_name() {
    for name in [
        "a+b.jpg", "a(1).jpg", "a'b.jpg", "a&b.jpg", "a\\b.jpg", "$a.jpg",
    ] {
        let mut fixture = plain_names();
        let key = fixture.clusters[0].key;
        fixture.scene.views[key.index()].name = name.into();
        let error = fixture
            .try_export("micmac", &ExportOptions::default())
            .err()
            .unwrap();
        assert!(
            matches!(error, BackendError::Name { .. }),
            "{name}: {error}"
        );
    }
}

#[test]
fn micmac_pairs_undirected() {
    let fixture = plain_names();
    let files = fixture.export("micmac");
    let pairs: Vec<String> = fixture
        .named()
        .iter()
        .flat_map(|(k, p)| p.iter().map(move |p| format!("{k} {p}")))
        .collect();
    assert_eq!(texts(files.text("pairs.xml"), "Cple"), pairs);
    assert!(
        viewrank::backends::by_name("micmac")
            .unwrap()
            .capabilities
            .notes
            .contains("undirected")
    );
}

#[test]
fn micmac_imsec_negative_score() {
    let fixture = plain_names();
    let files = fixture.export("micmac");
    for (key, partners) in fixture.named() {
        let xml = files.text(&format!("ImSec/ImSec-{key}.xml"));
        assert_eq!(texts(xml, "Master"), [key]);
        assert_eq!(texts(xml, "Images"), partners, "one element per partner");
        assert_eq!(
            (texts(xml, "Score"), texts(xml, "Sols").len()),
            (vec!["1".into()], 1),
            "one solution above -1"
        );
    }
}

#[test]
fn micmac_imsec_missing_is_silent() {
    let fixture = plain_names();
    let files = fixture.export("micmac");
    let masters: BTreeSet<String> = texts(files.text("ImSec/FileImSel.xml"), "Name")
        .into_iter()
        .collect();
    let there: BTreeSet<String> = files
        .names()
        .into_iter()
        .filter_map(|n| {
            Some(
                n.strip_prefix("ImSec/ImSec-")?
                    .strip_suffix(".xml")?
                    .to_owned(),
            )
        })
        .collect();
    assert_eq!(
        masters, there,
        "a file for each master: without one it would get no partners and no word"
    );
}

#[test]
fn micmac_imsec_overwritten() {
    let files = plain_names().export("micmac");
    let script = files.text("run.sh");
    let (copied, first_call) = (
        script.find("cp ImSec/*.xml").unwrap(),
        script.find("\"${MM3D:-mm3d}\" Malt").unwrap(),
    );
    assert!(
        copied < first_call && script.contains("cp -R \"$ori\"/. Ori-viewrank/"),
        "ours, in a copy of the user's folder"
    );
    assert!(
        !script.contains("AperoChImSecMM") && !script.contains("C3DC"),
        "these would write them anew"
    );
}

#[test]
fn micmac_one_malt_call_per_master() {
    let fixture = plain_names();
    let files = fixture.export("micmac");
    let calls: Vec<&str> = files
        .lines("run.sh")
        .into_iter()
        .map(str::trim)
        .filter(|l| l.contains("Malt GeomImage"))
        .collect();
    let wanted: Vec<String> = fixture
        .named()
        .iter()
        .map(|(k, _)| format!("\"${{MM3D:-mm3d}}\" Malt GeomImage {k} viewrank Master=AUTO &&"))
        .collect();
    assert_eq!(calls, wanted);
}

// AliceVision

fn sfm(rank: usize) -> (Fixture, Value) {
    let fixture = Fixture::new(3);
    let json = fixture
        .export("alicevision")
        .json(&format!("clusters/{rank:04}.sfm"));
    (fixture, json)
}

fn floats(value: &Value) -> Vec<f64> {
    value
        .as_array()
        .unwrap()
        .iter()
        .map(|v| v.as_str().unwrap().parse().unwrap())
        .collect()
}

#[test]
fn alicevision_range_is_position() {
    let (fixture, json) = sfm(2);
    let files = fixture.export("alicevision");
    let command = &files.0.record.commands[1];
    let position: usize = command
        .split("--rangeStart ")
        .nth(1)
        .unwrap()
        .split(' ')
        .next()
        .unwrap()
        .parse()
        .unwrap();
    let mut ids: Vec<u32> = json["views"]
        .as_array()
        .unwrap()
        .iter()
        .map(|v| v["viewId"].as_str().unwrap().parse().unwrap())
        .collect();
    ids.sort_unstable();
    assert_eq!(
        ids[position],
        fixture.scene.view(fixture.clusters[1].key).image_id
    );
    assert!(command.contains("--rangeSize 1 ") && command.contains("clusters/0002.sfm"));
}

#[test]
fn alicevision_needs_21_common_landmarks() {
    let mut fixture = Fixture::new(3);
    // A partner at the edge of what the key view sees.
    let last = fixture.connected(ViewIndex(12)).pop().unwrap();
    fixture.clusters[0].partners.push(last);
    let json = fixture.export("alicevision").json("clusters/0001.sfm");
    let key = fixture.scene.view(ViewIndex(12)).image_id.to_string();
    for partner in &fixture.clusters[0].partners {
        let id = fixture.scene.view(*partner).image_id.to_string();
        let sees = |l: &Value, id: &str| {
            l["observations"]
                .as_array()
                .unwrap()
                .iter()
                .any(|o| o["observationId"] == id)
        };
        let common = json["structure"]
            .as_array()
            .unwrap()
            .iter()
            .filter(|l| sees(l, &id) && sees(l, &key))
            .count();
        assert!(common > 20, "{common}");
    }
}

#[test]
fn alicevision_rotation_column_order() {
    let (fixture, json) = sfm(1);
    let id = fixture
        .scene
        .view(fixture.clusters[0].key)
        .image_id
        .to_string();
    let pose = json["poses"]
        .as_array()
        .unwrap()
        .iter()
        .find(|p| p["poseId"] == id)
        .unwrap();
    let r = fixture
        .scene
        .view(fixture.clusters[0].key)
        .cam_from_world
        .rotation;
    let written = floats(&pose["pose"]["transform"]["rotation"]);
    assert_eq!(
        written[1],
        r.matrix()[(1, 0)],
        "column by column, world to camera"
    );
}

#[test]
fn alicevision_principal_point_offset() {
    let (_, json) = sfm(1);
    let intrinsic = &json["intrinsics"][0];
    assert_eq!(
        floats(&intrinsic["principalPoint"]),
        [9.75, -11.0],
        "from the middle of the image, pixel centres at integers"
    );
    let number = |key: &str| intrinsic[key].as_str().unwrap().parse::<f64>().unwrap();
    assert!((number("focalLength") / number("sensorWidth") * 640.0 - 510.0).abs() < 1e-9);
}

#[test]
fn alicevision_dangling_observation() {
    let files = Fixture::new(3).export("alicevision");
    for name in files.names().into_iter().filter(|n| n.ends_with(".sfm")) {
        let json = files.json(name);
        let views: BTreeSet<&str> = json["views"]
            .as_array()
            .unwrap()
            .iter()
            .map(|v| v["viewId"].as_str().unwrap())
            .collect();
        let observations = json["structure"]
            .as_array()
            .unwrap()
            .iter()
            .flat_map(|l| l["observations"].as_array().unwrap());
        assert!(
            observations
                .into_iter()
                .all(|o| views.contains(o["observationId"].as_str().unwrap())),
            "{name}"
        );
    }
}

#[test]
fn alicevision_partners_symmetric() {
    let (fixture, json) = sfm(1);
    let key = fixture
        .scene
        .view(fixture.clusters[0].key)
        .image_id
        .to_string();
    let landmarks = json["structure"].as_array().unwrap();
    assert!(landmarks.iter().all(|l| {
        l["observations"]
            .as_array()
            .unwrap()
            .iter()
            .any(|o| o["observationId"] == key)
    }));
    assert_eq!(
        json["views"].as_array().unwrap().len(),
        4,
        "a file per key view, with its partners only"
    );
}

/// `-o` is short for both `--output` and `--outputMesh` of the meshing, which refuses it.
#[test]
fn alicevision_meshing_output_is_ambiguous() {
    let files = Fixture::new(3).export("alicevision");
    let meshing = |text: &str| {
        text.lines()
            .filter(|l| l.contains("aliceVision_meshing"))
            .map(str::to_owned)
            .collect::<Vec<_>>()
    };
    let calls = [
        meshing(&files.0.record.commands.join("\n")),
        meshing(files.text("run.sh")),
    ]
    .concat();
    assert_eq!(calls.len(), 2);
    assert!(
        calls
            .iter()
            .all(|call| call.contains(" --output ") && !call.contains(" -o ")),
        "{calls:?}"
    );
}

#[test]
fn alicevision_tile_cap_4() {
    let fixture = Fixture::new(6);
    let files = fixture.export("alicevision");
    let wanted =
        "--maxTCams 6 --chooseTCamsPerTile 0 --sgmMaxTCamsPerTile 6 --refineMaxTCamsPerTile 6 ";
    assert!(
        files.0.record.commands[0].contains(wanted),
        "{}",
        files.0.record.commands[0]
    );
}

/// Partners count by common landmarks within a range of angles: the range is set to all of them,
/// and whoever shares none is named.
#[test]
fn alicevision_names_the_partners_that_it_drops() {
    let mut fixture = Fixture::new(3);
    let (key, partner) = (fixture.clusters[0].key, fixture.clusters[0].partners[1]);
    assert!(!fixture.export("alicevision").says("shares no sparse point"));
    let scene = &mut fixture.scene;
    for p in 0..scene.points.len() {
        let track = scene.track_offsets[p]..scene.track_offsets[p + 1];
        if scene.track_views[track.clone()].contains(&key) {
            let other = scene.track_views[track.start];
            track
                .filter(|&o| scene.track_views[o] == partner)
                .collect::<Vec<_>>()
                .into_iter()
                .for_each(|o| scene.track_views[o] = other);
        }
    }
    let files = fixture.export("alicevision");
    assert!(files.says(&format!(
        "{}: its partner {} shares no sparse point",
        fixture.name(key),
        fixture.name(partner)
    )));
    let estimations = files
        .0
        .record
        .commands
        .iter()
        .filter(|c| c.contains("depthMapEstimation"));
    assert!(
        estimations
            .into_iter()
            .all(|c| c.contains("--minViewAngle 0 --maxViewAngle 180 "))
    );
}

// Metashape; what its script does is tested with a stand-in for Metashape in tests/python.

#[test]
fn metashape_no_partner_lists() {
    let fixture = Fixture::new(3);
    let files = fixture.export("metashape");
    let keys: Vec<String> = fixture.named().into_iter().map(|(key, _)| key).collect();
    assert_eq!(files.json("clusters.json")["keys"], serde_json::json!(keys));
    assert_eq!(files.json("clusters.json")["max_neighbors"], 3);
    assert!(files.says("matching partners"));
}

// RealityScan

#[test]
fn realityscan_union_only() {
    let fixture = Fixture::new(3);
    let files = fixture.export("realityscan");
    let used: BTreeSet<String> = fixture
        .named()
        .into_iter()
        .flat_map(|(k, p)| [vec![k], p].concat())
        .collect();
    assert_eq!(
        files
            .lines("images.txt")
            .into_iter()
            .map(str::to_owned)
            .collect::<BTreeSet<_>>(),
        used
    );
    let listed = files.lines("xmp.txt");
    assert_eq!(listed.len(), fixture.scene.views.len());
    for view in &fixture.scene.views {
        let name = format!("{}.xmp", view.name.trim_end_matches(".jpg"));
        assert!(listed.contains(&name.as_str()));
        assert_eq!(
            files
                .text(&format!("xmp/{name}"))
                .contains("xcr:InMeshing=\"1\""),
            used.contains(&view.name)
        );
    }
    assert!(files.says("partners take part in meshing as well"));
}

#[test]
fn realityscan_xmp_same_stem() {
    let mut fixture = Fixture::new(3);
    fixture.scene.views[0].name = "flight 0/img 001.tif".into();
    let error = fixture
        .try_export("realityscan", &ExportOptions::default())
        .err()
        .unwrap();
    assert!(error.to_string().contains("side file"), "{error}");
}

#[test]
fn realityscan_existing_xmp_poses() {
    let files = Fixture::new(3).export("realityscan");
    for name in files.names().into_iter().filter(|n| n.ends_with(".xmp")) {
        let mut reader = quick_xml::Reader::from_str(files.text(name));
        let mut attributes = BTreeSet::new();
        loop {
            match reader.read_event().unwrap() {
                Event::Empty(element) => {
                    attributes.extend(
                        element
                            .attributes()
                            .map(|a| a.unwrap().key.as_ref().to_owned()),
                    );
                }
                Event::Eof => break,
                _ => {}
            }
        }
        let switches = ["xcr:InMeshing", "xcr:InTexturing", "xmlns:xcr"].map(String::from);
        assert_eq!(
            attributes,
            BTreeSet::from(switches),
            "switches only, no pose"
        );
    }
    assert!(files.says("side files beside the images that hold poses are left as they are"));
}

#[test]
fn tables_name_every_image() {
    let fixture = Fixture::new(3);
    let names = table(fixture.export("acmm").text("view_names.txt"));
    assert_eq!(
        names.keys().copied().collect::<Vec<_>>(),
        (0..names.len()).collect::<Vec<_>>()
    );
}

#[test]
fn a_size_that_a_program_cannot_give_a_key_view_is_named() {
    let mut fixture = Fixture::new(3);
    fixture.clusters[1].scale = MapScale::Half;
    assert!(
        fixture
            .export("pmvs")
            .says("key views that are planned at half the size")
    );
    let openmvs = fixture.export("openmvs");
    let scales: Vec<_> = openmvs.json("run.json")["clusters"]
        .as_array()
        .unwrap()
        .iter()
        .map(|c| c["resolution"].as_f64().unwrap())
        .collect();
    assert_eq!(scales, [1.0, 0.5, 1.0, 1.0].map(|scale| scale * scales[0]));
    let sgm = fixture.export("sgm");
    assert_eq!(
        sgm.text("sizes.txt"),
        format!("{}\t0.5\n", fixture.named()[1].0)
    );
    assert!(
        [openmvs, sgm]
            .iter()
            .all(|files| !files.says("planned at half"))
    );
}

#[test]
fn names_with_a_line_break_are_refused_by_every_backend() {
    let mut fixture = Fixture::new(3);
    fixture.scene.views[12].name = "a.jpg\n../b.jpg".into();
    for backend in viewrank::backends::BACKENDS {
        let refused = fixture.try_export(backend.name, &ExportOptions::default());
        let error = refused.err().map(|error| error.to_string());
        assert!(
            error.is_some_and(|e| e.contains("a.jpg")),
            "{}",
            backend.name
        );
    }
}

#[test]
fn micmac_takes_no_image_for_a_file_of_its_own() {
    for name in ["mm3d-LogFile.txt", "Homol.xml"] {
        let mut fixture = Fixture::new(3);
        (0..fixture.scene.views.len())
            .for_each(|view| fixture.scene.views[view].name = format!("{view}.jpg"));
        fixture.scene.views[12].name = name.into();
        let refused = fixture.try_export("micmac", &ExportOptions::default());
        assert!(refused.err().unwrap().to_string().contains(name));
    }
}
