//! Nothing usable ends with an error, and files are named for what they are.

use super::*;

const POINTER: &str = "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 4478379\n";

#[test]
fn images_that_cannot_be_read_are_no_images() {
    let folder = Folder::new();
    folder.colmap("sparse/0", &ColmapModel::from_scene(&scene()));
    for n in 0..9 {
        folder.write(&format!("images/view_{n}.png"), POINTER);
    }
    let (code, stdout, stderr) = folder.plan(&["--backend", "openmvs"]);
    assert_eq!(code, 1);
    assert!(stderr.contains("Git LFS"), "{stderr}");
    assert!(
        !stdout.contains("run.py") && stdout.contains("git lfs pull"),
        "{stdout}"
    );
    let (code, ..) = said(&viewrank(&["run", folder.path().to_str().unwrap()]));
    assert_ne!(code, 0);
}

#[test]
fn images_of_other_names_or_shapes_are_others() {
    let renamed = Folder::new();
    renamed
        .colmap("sparse/0", &ColmapModel::from_scene(&scene()))
        .pictures(&scene(), |name| format!("images/photo_of_{name}"));
    let (code, _, stderr) = renamed.plan(&["--backend", "openmvs"]);
    assert_eq!(code, 1);
    assert!(
        stderr.contains("none of them is in") && stderr.contains("photo_of_view_0.png"),
        "{stderr}"
    );
    // The pictures have 100 x 75 pixels.
    let mut wide = scene();
    for camera in &mut wide.cameras {
        camera.width *= 2;
    }
    let other = Folder::new();
    other
        .colmap("sparse/0", &ColmapModel::from_scene(&wide))
        .pictures(&wide, |name| format!("images/{name}"));
    for backend in ["openmvs", "colmap", "pairs"] {
        let (code, stdout, stderr) = other.plan(&["--backend", backend]);
        assert_eq!(code, 1, "{backend}");
        assert!(
            stderr.contains("has 100 x 75 pixels, its camera 200 x 75"),
            "{stderr}"
        );
        assert!(
            !stdout.contains("run.py") && stdout.contains("Next: give the images that"),
            "{stdout}"
        );
    }
}

#[test]
fn positions_that_do_not_fit_are_named() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &ColmapModel::from_scene(&scene()))
        .pictures(&scene(), |name| format!("images/{name}"));
    let (_, stdout, _) = folder.plan(&["--dry-run"]);
    assert!(!stdout.contains("GPS"), "{stdout}");
    // All from one place.
    for n in 0..9 {
        folder.write(&format!("images/view_{n}.png"), with_position([0.0; 2]));
    }
    let (_, stdout, _) = folder.plan(&["--dry-run"]);
    assert!(
        stdout.contains("The GPS positions of 9 images are not used"),
        "{stdout}"
    );
    // What they keep from being used as it was typed, too.
    let degrees = r#"{"type":"Polygon","coordinates":[[[13,52],[13.1,52],[13,52.1],[13,52]]]}"#;
    folder.write("site.geojson", degrees);
    let region = folder.at("site.geojson").display().to_string();
    for asked in [["--region", &region], ["--gsd", "2cm"]] {
        let (code, _, stderr) = folder.plan(&asked);
        assert_ne!(code, 0, "{stderr}");
        assert!(
            stderr.contains("The GPS positions of 9 images are not used"),
            "{stderr}"
        );
    }
}

#[test]
fn a_model_placed_by_positions_is_in_metres_on_its_page_too() {
    let folder = Folder::new();
    folder.colmap("sparse/0", &ColmapModel::from_scene(&scene()));
    for view in &scene().views {
        // Two metres in a unit; a second of arc is 30.9 m to the north, and 19.1 to the east at
        // 52°.
        let centre = view.cam_from_world.centre();
        let position = [200.0 + 2.0 * centre.y, 200.0 + 2.0 * centre.x];
        let seconds = [position[0] / 30.9, position[1] / 19.06];
        folder.write(&format!("images/{}", view.name), with_position(seconds));
    }
    let (code, stdout, stderr) = folder.plan(&["--backend", "pairs", "--report"]);
    assert_eq!(code, 0, "{stderr}");
    assert!(stdout.contains("On earth by the GPS of 9"), "{stdout}");
    let metres = || {
        let page = fs::read_to_string(folder.at("viewrank/report.html")).unwrap();
        let (_, rest) = page.split_once("\"metres\":").unwrap();
        let (number, _) = rest.split_once(',').unwrap();
        number.parse::<f64>().ok()
    };
    assert!((metres().unwrap() - 2.0).abs() < 0.05, "{:?}", metres());
    // Made again from the plan's record.
    let again = viewrank(&["report", folder.path().to_str().unwrap()]);
    assert!(again.status.success());
    assert!((metres().unwrap() - 2.0).abs() < 0.05, "{:?}", metres());
}

#[test]
fn pictures_that_a_viewer_has_turned_are_said_to_be() {
    let mut upright = scene();
    for camera in &mut upright.cameras {
        *camera = Camera::new(
            1,
            CameraModel::Pinhole,
            75,
            100,
            vec![85.0, 85.0, 37.5, 50.0],
        )
        .unwrap();
    }
    for view in &mut upright.views {
        view.name = view.name.replace("png", "jpg");
    }
    let entry = [0x12, 1, 3, 0, 1, 0, 0, 0, 6, 0, 0, 0];
    let turned = jpeg_with(&[&b"II*\0\x08\0\0\0\x01\0"[..], &entry, &[0; 4]].concat());
    let plain = jpeg_with(b"II*\0\x08\0\0\0\0\0\0\0\0\0");
    for (picture, why, cure) in [
        (turned, "EXIF orientation says", "-auto-orient"),
        (plain, "it was rotated by 90°", "camera's card"),
    ] {
        let folder = Folder::new();
        folder.colmap("sparse/0", &ColmapModel::from_scene(&upright));
        for view in &upright.views {
            folder.write(&format!("images/{}", view.name), &picture);
        }
        let (code, stdout, stderr) = folder.plan(&["--backend", "openmvs"]);
        assert_eq!(code, 1, "{stdout}");
        let stderr = stderr.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(stderr.contains(why) && stderr.contains(cure), "{stderr}");
        let (_, doctor, _) = said(&viewrank(&["doctor", folder.path().to_str().unwrap()]));
        let doctor = doctor.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(doctor.contains(why) && doctor.contains(cure), "{doctor}");
    }
}

/// A JPEG file of 100 x 75 pixels with this EXIF data.
fn jpeg_with(tiff: &[u8]) -> Vec<u8> {
    let mut picture = std::io::Cursor::new(Vec::new());
    let grey = image::GrayImage::new(100, 75);
    grey.write_to(&mut picture, image::ImageFormat::Jpeg)
        .unwrap();
    let exif = [b"Exif\0\0", tiff].concat();
    let jpeg = picture.into_inner();
    let length = (exif.len() as u16 + 2).to_be_bytes();
    [&jpeg[..2], b"\xff\xe1", &length, &exif, &jpeg[2..]].concat()
}

/// A picture of 100 x 75 pixels taken at 52° and 21° and so many seconds of arc to the north and to
/// the east.
fn with_position([north, east]: [f64; 2]) -> Vec<u8> {
    let entry = |tag: u16, kind: u16, count: u32, value: u32| {
        let [tag, kind] = [tag, kind].map(u16::to_le_bytes).map(Vec::from);
        let [count, value] = [count, value].map(u32::to_le_bytes).map(Vec::from);
        [tag, kind, count, value].concat()
    };
    let directory = |entries: &[Vec<u8>]| {
        let count = (entries.len() as u16).to_le_bytes();
        [&count[..], &entries.concat(), &[0; 4]].concat()
    };
    let degrees = |degrees: u32, seconds: f64| -> Vec<u8> {
        let numbers = [degrees, 1, 0, 1, (1e6 * seconds) as u32, 1_000_000];
        numbers.into_iter().flat_map(u32::to_le_bytes).collect()
    };
    // The GPS directory follows that of the image, and its numbers follow it.
    let first = directory(&[entry(0x8825, 4, 1, 26)]);
    let numbers = 26 + 2 + 4 * 12 + 4;
    let gps = directory(&[
        entry(1, 2, 2, u32::from(b'N')),
        entry(2, 5, 3, numbers),
        entry(3, 2, 2, u32::from(b'E')),
        entry(4, 5, 3, numbers + 24),
    ]);
    jpeg_with(
        &[
            b"II*\0\x08\0\0\0".as_slice(),
            &first,
            &gps,
            &degrees(52, north),
            &degrees(21, east),
        ]
        .concat(),
    )
}

#[test]
fn files_of_a_model_are_named_for_what_they_are() {
    let model = ColmapModel::from_scene(&scene());
    let folder = Folder::new();
    let error = |name: &str, bytes: &[u8]| {
        folder.colmap("sparse/0", &model).write(name, bytes);
        folder.open().read_scene().unwrap_err().to_string()
    };
    assert!(error("sparse/0/points3D.bin", POINTER.as_bytes()).contains("Git LFS"));
    assert!(error("sparse/0/images.bin", b"<!DOCTYPE html><html>").contains("web page"));
    let other = Folder::new();
    other.write("scene.nvm", b"PK\x03\x04 and so on");
    let error = Project::open(other.path(), None).unwrap_err();
    assert!(error.to_string().contains("ZIP"), "{error}");
    let none = Folder::new();
    none.write("cameras.xml", POINTER);
    let (code, _, stderr) = none.plan(&[]);
    assert!(code == 1 && stderr.contains("git lfs pull"), "{stderr}");
}

#[test]
fn a_byte_order_mark_is_no_part_of_a_text() {
    let model = ColmapModel::from_scene(&scene());
    let folder = Folder::new();
    folder
        .colmap_text("sparse/0", &model)
        .pictures(&scene(), |name| format!("photos/{name}"));
    for name in ["cameras", "images", "points3D"] {
        let path = format!("sparse/0/{name}.txt");
        let marked = [&b"\xef\xbb\xbf"[..], &fs::read(folder.at(&path)).unwrap()].concat();
        folder.write(&path, marked);
    }
    let read = folder.read();
    assert_eq!(
        (read.views.len(), read.observations()),
        (9, scene().observations())
    );
    assert_eq!(
        folder.open().images.unwrap().to_path_buf(),
        folder.at("photos")
    );
    let json = "\u{feff}[{\"cameras\":{},\"shots\":{}}]";
    let other = Folder::new();
    other.write("reconstruction.json", json);
    assert_eq!(other.read().views.len(), 0);
}

#[test]
fn files_of_other_programs_are_named_for_what_they_are() {
    let kinds = [
        ("project.psx", "Metashape project", "Export Cameras"),
        ("site.rsproj", "RealityScan", "export"),
        ("cloud.las", "point cloud", "cameras"),
        ("model.zip", "ZIP", "unpack"),
        ("database.db", "database", "colmap mapper"),
        ("distorted/database.db", "database", "colmap mapper"),
        ("site.p4d", "Pix4D project", "opf2colmap"),
        (
            "site/1_initial/site_calibrated_camera_parameters.txt",
            "Pix4D's cameras",
            "opf2colmap",
        ),
        (
            "site_calibrated_external_camera_parameters_wgs84.txt",
            "Pix4D's cameras",
            "OPF",
        ),
        ("poses_bounds.npy", "LLFF", "COLMAP model"),
        ("frame_pose_0.txt", "list of poses", "point_triangulator"),
        (
            "seq/frame-000000.pose.txt",
            "list of poses",
            "point_triangulator",
        ),
        ("poses.csv", "list of poses", "point_triangulator"),
        ("groundtruth.txt", "list of poses", "point_triangulator"),
        ("cameras.json", "list of cameras", "COLMAP"),
        ("data.tar.gz", "archive", "unpack"),
    ];
    for (name, what, cure) in kinds {
        let folder = Folder::new();
        folder
            .pictures(&scene(), |name| format!("images/{name}"))
            .write(name, "of a program");
        let file = folder.at(name);
        for path in [folder.path(), &file] {
            let (code, _, stderr) = said(&viewrank(&["plan", path.to_str().unwrap()]));
            assert_eq!(code, 1, "{stderr}");
            assert!(stderr.contains(what) && stderr.contains(cure), "{stderr}");
            assert!(stderr.contains(name), "{stderr}");
        }
        // Beside a model it is none of our business.
        folder.colmap("sparse/0", &ColmapModel::from_scene(&scene()));
        assert_eq!(folder.read().views.len(), 9);
    }
}

#[test]
fn models_that_are_compressed_are_to_be_unpacked() {
    let kinds = [
        "sparse/0/cameras.bin.gz",
        "sparse/points3D.txt.gz",
        "reconstruction.json.gz",
        "opensfm/reconstruction.json.gz",
        "transforms.json.xz",
        "scene.nvm.gz",
        "scene.mvs.zst",
    ];
    for name in kinds {
        let folder = Folder::new();
        folder
            .pictures(&scene(), |name| format!("images/{name}"))
            .write(name, "packed");
        let (code, _, stderr) = folder.plan(&[]);
        assert_eq!(code, 1, "{stderr}");
        assert!(
            stderr.contains(name)
                && stderr.contains("is compressed with")
                && stderr.contains("unpack it"),
            "{stderr}"
        );
    }
    // One of the files of a model, and one beside a whole model.
    let folder = Folder::new();
    folder.colmap("sparse/0", &ColmapModel::from_scene(&scene()));
    let points = folder.at("sparse/0/points3D.bin");
    fs::rename(&points, points.with_extension("bin.gz")).unwrap();
    let (_, _, stderr) = folder.plan(&[]);
    assert!(stderr.contains("gunzip"), "{stderr}");
    folder.colmap("sparse/0", &ColmapModel::from_scene(&scene()));
    assert_eq!(folder.read().views.len(), 9);
}

#[test]
fn a_list_of_cameras_of_another_program_is_no_half_model_of_colmap() {
    let folder = Folder::new();
    folder
        .pictures(&scene(), |name| format!("images/{name}"))
        .write(
            "cameras.txt",
            "# Cameras (1)\n# PhotoID, X, Y, Z\nIMG_1.JPG, 1, 2, 3\n",
        );
    let (code, _, stderr) = folder.plan(&[]);
    assert_eq!(code, 1);
    assert!(
        stderr.contains("list of cameras") && stderr.contains("point_triangulator"),
        "{stderr}"
    );
    folder.write(
        "cameras.txt",
        "# Camera list\n1 PINHOLE 100 75 85 85 50 37.5\n",
    );
    let (_, _, stderr) = folder.plan(&[]);
    assert!(
        stderr.contains("images.txt, points3D.txt missing"),
        "{stderr}"
    );
}

#[test]
fn a_text_model_named_as_a_binary_one_is_text() {
    let folder = Folder::new();
    folder.colmap_text("sparse/0", &ColmapModel::from_scene(&scene()));
    for name in ["cameras", "images", "points3D"] {
        let text = folder.at(&format!("sparse/0/{name}.txt"));
        fs::rename(&text, text.with_extension("bin")).unwrap();
    }
    let (code, _, stderr) = folder.plan(&[]);
    assert_eq!(code, 1);
    assert!(
        stderr.contains("is text") && stderr.contains("cameras.txt"),
        "{stderr}"
    );
}

#[test]
fn pictures_that_no_program_reads_are_to_be_converted() {
    let kinds: [(&str, &[u8], &str); 4] = [
        ("HEIC", b"\0\0\0\x18ftypheic\0\0\0\0mif1heic", "HEIC"),
        ("avif", b"\0\0\0\x18ftypavif\0\0\0\0mif1avif", "AVIF"),
        ("gif", b"GIF89a\x64\0\x4b\0\0\0\0;", "GIF"),
        ("webp", b"RIFF\x1a\0\0\0WEBPVP8L\x0d\0\0\0\x2f", "webp"),
    ];
    for (extension, bytes, what) in kinds {
        let mut scene = scene();
        let folder = Folder::new();
        for view in &mut scene.views {
            view.name = view.name.replace("png", extension);
            folder.write(&format!("images/{}", view.name), bytes);
        }
        folder.colmap("sparse/0", &ColmapModel::from_scene(&scene));
        let (_, stdout, _) = folder.plan(&[]);
        assert!(stdout.contains("Next: convert the images"), "{stdout}");
        for backend in ["openmvs", "sgm"] {
            let (code, stdout, stderr) = folder.plan(&["--backend", backend]);
            assert_eq!(code, 1, "{extension}: {stderr}");
            assert!(
                stderr.contains(what) && !stderr.contains("broken image"),
                "{stderr}"
            );
            assert!(stdout.contains("Next: convert the images"), "{stdout}");
        }
    }
}

#[test]
fn pictures_that_are_cut_off_are_no_export_whatever_their_format() {
    let formats = [
        ("jpg", image::ImageFormat::Jpeg),
        ("png", image::ImageFormat::Png),
        ("tif", image::ImageFormat::Tiff),
    ];
    for (extension, format) in formats {
        let (mut scene, folder) = (scene(), Folder::new());
        let mut picture = std::io::Cursor::new(Vec::new());
        let grey = image::GrayImage::from_fn(100, 75, |x, y| image::Luma([(x * y) as u8]));
        grey.write_to(&mut picture, format).unwrap();
        for view in &mut scene.views {
            view.name = view.name.replace("png", extension);
            folder.write(&format!("images/{}", view.name), picture.get_ref());
        }
        folder.colmap("sparse/0", &ColmapModel::from_scene(&scene));
        let (code, _, stderr) = folder.plan(&["--backend", "openmvs"]);
        assert_eq!(code, 0, "{extension}: {stderr}");
        let whole = picture.get_ref();
        for view in &scene.views {
            // The directory of this TIFF is behind its pixels: its readers would find nothing.
            let mut cut = whole[..whole.len() / 2].to_vec();
            if format == image::ImageFormat::Tiff {
                cut = tiff_with_directory_first();
            }
            folder.write(&format!("images/{}", view.name), cut);
        }
        let (code, stdout, stderr) = folder.plan(&["--backend", "openmvs"]);
        assert_eq!(code, 1, "{extension}: {stderr}");
        assert!(stderr.contains("is truncated"), "{extension}: {stderr}");
        assert!(stdout.contains("Next: copy them again"), "{stdout}");
    }
}

/// A TIFF of 100 by 75 grey pixels, all of which are missing.
fn tiff_with_directory_first() -> Vec<u8> {
    let (short, long) = (3u16, 4u16);
    let tags = [
        (256u16, short, 100u32),
        (257, short, 75),
        (258, short, 8),
        (259, short, 1),
        (262, short, 1),
        (273, long, 200),
        (277, short, 1),
        (278, short, 75),
        (279, long, 7500),
    ];
    let mut bytes = b"II*\0\x08\0\0\0".to_vec();
    bytes.extend((tags.len() as u16).to_le_bytes());
    for (tag, kind, value) in tags {
        bytes.extend(tag.to_le_bytes());
        bytes.extend(kind.to_le_bytes());
        bytes.extend(1u32.to_le_bytes());
        bytes.extend(value.to_le_bytes());
    }
    bytes.extend([0; 4]);
    bytes
}

#[test]
fn a_mask_that_is_a_pointer_is_said_to_be_one() {
    let folder = Folder::new();
    let pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n";
    folder
        .colmap("sparse/0", &ColmapModel::from_scene(&scene()))
        .pictures(&scene(), |name| format!("images/{name}"));
    for view in &scene().views {
        folder.write(&format!("masks/{}.png", view.name), pointer);
    }
    let path = folder.path().to_str().unwrap();
    let (_, _, stderr) = said(&viewrank(&["plan", path, "--backend", "openmvs"]));
    assert!(stderr.contains("its mask: a Git LFS pointer"), "{stderr}");
}

#[test]
fn panoramas_are_to_be_cut_before_anything_else() {
    let folder = Folder::new();
    let mut model = ColmapModel::from_scene(&scene());
    let panorama = Camera::new(2, CameraModel::Equirectangular, 100, 75, vec![100.0, 75.0]);
    let distorted = vec![85.0, 50.0, 37.5, 0.001];
    let distorted = Camera::new(1, CameraModel::SimpleRadial, 100, 75, distorted);
    model.cameras = vec![distorted.unwrap(), panorama.unwrap()];
    model.images[3].camera_id = 2;
    folder
        .colmap("sparse/0", &model)
        .pictures(&scene(), |name| format!("images/{name}"));
    let (_, stdout, stderr) = folder.plan(&["--backend", "openmvs"]);
    assert!(
        stdout.contains("Next: cut the panoramas"),
        "{stdout}{stderr}"
    );
    assert!(
        stderr.contains("SIMPLE_RADIAL: cut the panoramas"),
        "{stderr}"
    );
    let (_, _, stderr) = folder.plan(&["--backend", "splat"]);
    assert!(
        stderr.contains("no panoramas: cut the panoramas"),
        "{stderr}"
    );
    let path = folder.path().to_str().unwrap();
    let (_, stdout, _) = said(&viewrank(&["doctor", path]));
    assert!(stdout.contains("cut the panoramas"), "{stdout}");
    assert!(!stdout.contains("viewrank undistort"), "{stdout}");
    let words = stdout.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(
        words.contains("the cameras are EQUIRECTANGULAR or SIMPLE_RADIAL"),
        "{stdout}"
    );
}

/// A block without distortion, in a reference system, its photos seen from 10 above.
fn block(definition: &str) -> String {
    let photo = |id: usize| {
        format!(
            "<Photo><Id>{id}</Id><ImagePath>view_{id}.png</ImagePath><Pose><Rotation><M_00>1</M_00><M_01>0</M_01><M_02>0</M_02><M_10>0</M_10>\
             <M_11>-1</M_11><M_12>0</M_12><M_20>0</M_20><M_21>0</M_21><M_22>-1</M_22></Rotation><Center><x>{id}</x><y>0</y><z>10</z></Center>\
             </Pose></Photo>"
        )
    };
    let photos: String = (0..3).map(photo).collect();
    format!(
        "<BlocksExchange version=\"3.2\"><SpatialReferenceSystems><SRS><Id>0</Id><Definition>{definition}</Definition></SRS>\
         </SpatialReferenceSystems><Block><Name>b</Name><SRSId>0</SRSId><Photogroups><Photogroup><ImageDimensions><Width>100</Width>\
         <Height>75</Height></ImageDimensions><FocalLengthPixels>85</FocalLengthPixels>{photos}</Photogroup></Photogroups></Block></BlocksExchange>"
    )
}

#[test]
fn a_local_frame_of_a_block_is_on_earth_and_in_metres() {
    let folder = Folder::new();
    folder.write("block.xml", block("ENU:30.17,-98.08"));
    let place = folder.read().georeference.unwrap();
    let origin = place.geodetic(&nalgebra::Point3::origin()).unwrap();
    assert!((origin.latitude - 30.17).abs() < 1e-9 && (origin.longitude + 98.08).abs() < 1e-9);
    assert_eq!(place.metres_per_unit(), Some(1.0));
    let (_, stdout, _) = said(&viewrank(&["inspect", folder.path().to_str().unwrap()]));
    assert!(
        stdout.contains("metres") && !stdout.contains("units per pixel"),
        "{stdout}"
    );
    for other in ["ENU:95,0", "ENU:a,b", "ENU:1"] {
        folder.write("block.xml", block(other));
        assert!(folder.read().georeference.is_none(), "{other}");
    }
}

#[test]
fn a_resolution_in_metres_does_not_hide_what_is_wrong_with_the_model() {
    let folder = Folder::new();
    folder.write("block.xml", block("EPSG:4326"));
    let (code, _, stderr) = folder.plan(&["--gsd", "5cm"]);
    assert_eq!(code, 1, "{stderr}");
    assert!(stderr.contains("longitude and latitude"), "{stderr}");
}

#[test]
fn json_of_another_kind_is_named_for_what_it_is() {
    let folder = Folder::new();
    folder.pictures(&scene(), |name| format!("images/{name}"));
    for (json, what) in [
        (r#"{"type":"FeatureCollection","features":[]}"#, "GeoJSON"),
        (r#"{"name":"site"}"#, "JSON of another kind"),
    ] {
        folder.write("transforms.json", json);
        let (code, _, stderr) = folder.plan(&[]);
        assert_eq!(code, 1);
        assert!(stderr.contains(what), "{stderr}");
        assert!(!stderr.contains("correct the line"), "{stderr}");
    }
}

#[test]
fn json_that_is_no_object_says_what_was_expected() {
    let folder = Folder::new();
    for (json, what) in [
        ("[1]", "a list, where an object with a list of \"frames\""),
        ("[]", "a list, where"),
        ("3", "a number, where"),
        (
            r#"{"frames":[["a.jpg",[]]]}"#,
            "\"transform_matrix\" is expected",
        ),
    ] {
        folder.write("transforms.json", json);
        let (code, _, stderr) = folder.plan(&[]);
        assert_eq!(code, 1);
        assert!(stderr.contains(what), "{json}: {stderr}");
    }
    folder.write("transforms.json", "[1");
    assert!(!folder.plan(&[]).2.contains("where an object"));
}

#[test]
fn poses_without_a_file_of_points_are_completed_by_a_cloud() {
    let folder = Folder::new();
    folder.colmap("sparse/0", &ColmapModel::from_scene(&scene()));
    fs::remove_file(folder.at("sparse/0/points3D.bin")).unwrap();
    let (code, _, stderr) = folder.plan(&[]);
    assert_eq!(code, 1);
    assert!(stderr.contains("PLY cloud"), "{stderr}");
}

#[test]
fn observations_by_projection_have_no_error() {
    let folder = Folder::new();
    let mut model = ColmapModel::from_scene(&scene());
    for image in &mut model.images {
        image.points2d = Default::default();
    }
    for point in &mut model.points {
        point.track = Default::default();
    }
    folder.colmap("sparse/0", &model);
    let root = folder.path().to_str().unwrap();
    let (_, stdout, _) = said(&viewrank(&["inspect", root]));
    assert!(!stdout.contains("reprojection error"), "{stdout}");
}

#[test]
fn a_watched_folder_without_a_project_is_said_to_have_none() {
    let folder = Folder::new();
    let root = folder.path().to_str().unwrap();
    let (code, _, stderr) = said(&viewrank(&["watch", root, "--once"]));
    assert_eq!(code, 0);
    assert!(stderr.contains("no project was found in"), "{stderr}");
}

#[test]
fn sentences_of_a_summary_are_wrapped_and_its_commands_are_not() {
    let folder = Folder::new();
    let long = "a folder of a name that is so long that no command with it fits on a line of usual width/project";
    folder
        .colmap(
            &format!("{long}/sparse/0"),
            &ColmapModel::from_scene(&scene()),
        )
        .pictures(&scene(), |name| format!("{long}/images/{name}"))
        .pictures(&scene(), |name| {
            format!("{long}/images/of another flight/{name}")
        });
    let root = folder.at(long).display().to_string();
    let (_, stdout, _) = said(&viewrank(&["plan", &root, "--dry-run", "--verbose"]));
    let commands = stdout.split_once("\nNothing was written").unwrap();
    assert!(commands.0.lines().all(|line| line.len() <= 100), "{stdout}");
    assert!(
        commands
            .1
            .lines()
            .any(|line| line.starts_with("Next: ") && line.contains("project")),
        "{stdout}"
    );
}

#[test]
fn fewer_images_than_each_place_needs_are_counted() {
    let folder = Folder::new();
    folder
        .colmap("sparse/0", &ColmapModel::from_scene(&scene()))
        .pictures(&scene(), |name| format!("images/{name}"))
        .write("viewrank.toml", "coverage.min_cameras = 10\n");
    let (code, _, stderr) = folder.plan(&["--backend", "sgm"]);
    assert!(
        code != 0 && stderr.contains("the model has 9 images, and each place must be seen by 10"),
        "{stderr}"
    );
}
