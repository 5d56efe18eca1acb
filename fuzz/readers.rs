//! Shared code of the fuzz targets and of `tests/slow/fuzz_readers.rs`: replaces one file of a
//! small valid model by the fuzzer's bytes, and checks that a model that can be read is consistent
//! and round-trips.

use viewrank_core::model::scene::Scene;
use viewrank_io::{
    formats::{
        Bytes, Fault, alicevision, blocks, bundler,
        colmap::{ColmapImage, ColmapModel, ImageUse},
        colmap_bin, colmap_text,
        foreign::ForeignModel,
        metashape::{self, Frame},
        micmac, mve, nvm, openmvg, openmvs, opensfm, sure, transforms,
    },
    region_file::{self, RegionFile},
};

/// The files of a model: names and contents.
pub type Files = Vec<(&'static str, Vec<u8>)>;

/// COLMAP files to replace, one fuzz target each.
pub const TARGETS: [&str; 10] = [
    "cameras.bin",
    "images.bin",
    "points3D.bin",
    "rigs.bin",
    "frames.bin",
    "cameras.txt",
    "images.txt",
    "points3D.txt",
    "rigs.txt",
    "frames.txt",
];

/// Model files of other programs, one fuzz target each.
pub const FOREIGN: [&str; 13] = [
    "bundle.out",
    "model.nvm",
    "sfm_data.json",
    "reconstruction.json",
    "scene.sfm",
    "scene.mvs",
    "image.ori",
    "transforms.json",
    "cameras.xml",
    "block.xml",
    "synth_0.out",
    "Orientation-a.jpg.xml",
    "AutoCal.xml",
];

/// Reads a region; positions and wishes of one that can be read are numbers.
pub fn read_region(data: &[u8]) {
    if let Ok(RegionFile::Areas(areas)) = region_file::parse(data) {
        let rings = areas.areas.iter().flat_map(|area| &area.polygons).flatten();
        assert!(rings.flatten().flatten().all(|x| x.is_finite()));
        assert!(
            areas
                .areas
                .iter()
                .all(|area| area.weight >= 0.0 && area.gsd.is_none_or(|gsd| gsd > 0.0))
        );
    }
}

/// A small valid region.
pub const REGION: &str = r#"{"type":"FeatureCollection","crs":null,"axes":[[1,0,0],[0,1,0],[0,0,1]],"features":[{"type":"Feature","properties":{"weight":0.5,"gsd":0.01},"geometry":{"type":"MultiPolygon","coordinates":[[[[0,0],[9,0],[9,9],[0,0]],[[1,1],[2,1],[2,2],[1,1]]],[[[20,0],[30,0],[30,5]]]]}}]}"#;

/// A small valid model file of another program.
pub fn foreign_model(name: &str) -> Vec<u8> {
    let text: &str = match name {
        "bundle.out" => {
            "# Bundle file v0.3\n2 1\n0 0 0\n0 0 0\n0 0 0\n0 0 0\n0 0 0\n100 0.1 0.2\n1 0 0\n0 1 0\n0 0 1\n0 0 -5\n1 2 3\n10 20 30\n2 0 0 1 1 1 0 -20 10\n"
        }
        "model.nvm" => {
            "NVM_V3 \n\n2\na.jpg 100 1 0 0 0 1 2 3 0.01 0\nc.jpg 100 1 0 0 0 0 0 0 0 0\n\n1\n0 0 9 1 2 3 2 0 0 -5 5 1 0 30 20\n\n0\n"
        }
        "sfm_data.json" => {
            r#"{"sfm_data_version":"0.3","root_path":"/x","views":[{"key":0,"value":{"polymorphic_id":1073741824,"ptr_wrapper":{"id":1,"data":{"local_path":"","filename":"a.jpg","width":10,"height":8,"id_view":0,"id_intrinsic":0,"id_pose":0}}}}],"intrinsics":[{"key":0,"value":{"polymorphic_id":2147483649,"polymorphic_name":"pinhole_radial_k1","ptr_wrapper":{"id":2,"data":{"width":10,"height":8,"focal_length":9.5,"principal_point":[5.0,4.0],"disto_k1":[-0.01]}}}}],"extrinsics":[{"key":0,"value":{"rotation":[[1,0,0],[0,1,0],[0,0,1]],"center":[0,0,0]}}],"structure":[{"key":7,"value":{"X":[0,0,5],"observations":[{"key":0,"value":{"id_feat":1,"x":[5,4]}}]}}]}"#
        }
        "reconstruction.json" => {
            r#"[{"cameras":{"c":{"projection_type":"perspective","width":40,"height":20,"focal":0.9,"k1":0.1,"k2":0.2}},"shots":{"a.jpg":{"rotation":[0,0,1.5],"translation":[1,2,3],"camera":"c"}},"points":{"17":{"coordinates":[0,0,1],"color":[1,2,3]}}}]"#
        }
        "scene.sfm" => {
            r#"{"version":["1","2","8"],"views":[{"viewId":"7","poseId":"3","intrinsicId":"1","path":"/d/a.jpg"}],"intrinsics":[{"intrinsicId":"1","width":"100","height":"50","type":"pinhole","distortionType":"radialk3","undistortionType":"none","sensorWidth":"20","focalLength":"18","principalPoint":["-1","1"],"distortionParams":["0.1","0.2","0.3"]}],"poses":[{"poseId":"3","pose":{"transform":{"rotation":["0","1","0","-1","0","0","0","0","1"],"center":["1","2","3"]}}}],"structure":[{"landmarkId":"4","color":["1","2","3"],"X":["0","0","5"],"observations":[{"observationId":"7","x":["10","20"]}]}]}"#
        }
        "transforms.json" => {
            r#"{"w":100,"h":80,"fl_x":90.5,"fl_y":91,"cx":50,"cy":40,"k1":0.01,"camera_model":"OPENCV","frames":[{"file_path":"images/a.jpg","transform_matrix":[[1,0,0,1],[0,-1,0,2],[0,0,-1,3],[0,0,0,1]]},{"file_path":"b.jpg","fl_x":50,"transform_matrix":[[0,1,0,0],[-1,0,0,0],[0,0,1,0]]}],"ply_file_path":"sparse_pc.ply"}"#
        }
        "image.ori" => {
            "$ImageID____(ORI_Ver_1.0)\n\ta.jpg\n$IntOri_SensorSize_____(x|y)____[pixel]\n\t100\t80\n$IntOri_CameraMatrix____(ImageCoordinateSystem)\n\t90 0 49.5\n\t0 90 39.5\n\t0 0 1\n$ExtOri_RotationMatrix____(World->ImageCoordinateSystem)\n\t1 0 0\n\t0 1 0\n\t0 0 1\n$ExtOri_TranslationVector____(WorldCoordinateSystem)\n\t1 2 3\n$IntOri_Distortion_____(Model|ParameterCount|(Parameters))____\n\tNONE 0\n"
        }
        "cameras.xml" => {
            r#"<?xml version="1.0"?><document version="2.0.0"><chunk label="a &amp; b"><sensors><sensor id="0" type="frame"><resolution width="100" height="80"/><calibration type="frame" class="adjusted"><f>90</f><cx>1</cx><b1>0.5</b1><k1>0.1</k1><p1>0.01</p1></calibration></sensor></sensors><components><component id="0"><transform><rotation>1 0 0 0 1 0 0 0 1</rotation><translation>1 2 3</translation><scale>2</scale></transform></component></components><cameras><camera id="0" label="a.jpg" sensor_id="0" component_id="0"><transform>1 0 0 1 0 1 0 2 0 0 1 3 0 0 0 1</transform></camera><group><camera id="1" label="b.jpg" sensor_id="0"/></group></cameras></chunk></document>"#
        }
        "block.xml" => {
            r#"<?xml version="1.0"?><BlocksExchange version="3.2"><SpatialReferenceSystems><SRS><Id>0</Id><Definition>EPSG:2154</Definition></SRS></SpatialReferenceSystems><Block><SRSId>0</SRSId><Photogroups><Photogroup><ImageDimensions><Width>100</Width><Height>80</Height></ImageDimensions><FocalLength>9</FocalLength><SensorSize>10</SensorSize><CameraOrientation>XRightYUp</CameraOrientation><PrincipalPoint><x>50</x><y>40</y></PrincipalPoint><Distortion><K1>0.1</K1><P1>0.01</P1></Distortion><Photo><Id>7</Id><ImagePath>D:\p\a.jpg</ImagePath><Pose><Rotation><M_00>1</M_00><M_01>0</M_01><M_02>0</M_02><M_10>0</M_10><M_11>1</M_11><M_12>0</M_12><M_20>0</M_20><M_21>0</M_21><M_22>1</M_22></Rotation><Center><x>1</x><y>2</y><z>3</z></Center></Pose></Photo></Photogroup></Photogroups><TiePoints><TiePoint><Position><x>1</x><y>2</y><z>9</z></Position><Color><Red>1</Red></Color><Measurement><PhotoId>7</PhotoId><x>10</x><y>20</y></Measurement></TiePoint></TiePoints></Block></BlocksExchange>"#
        }
        "Orientation-a.jpg.xml" => {
            "<?xml version=\"1.0\" ?><ExportAPERO><OrientationConique><TypeProj>eProjStenope</TypeProj><FileInterne>Ori-A/AutoCal.xml</FileInterne><Externe><Centre>1 2 3</Centre><ParamRotation><CodageMatr><L1>0 0 1</L1><L2>1 0 0</L2><L3>0 1 0</L3></CodageMatr></ParamRotation></Externe></OrientationConique></ExportAPERO>"
        }
        "AutoCal.xml" => {
            "<ExportAPERO><CalibrationInternConique><KnownConv>eConvApero_DistM2C</KnownConv><PP>50.5 40</PP><F>90</F><SzIm>100 80</SzIm><CalibDistortion><ModPhgrStd><RadialePart><CDist>51 40</CDist><CoeffDist>1e-6</CoeffDist><CoeffDist>1e-11</CoeffDist></RadialePart><P1>1e-6</P1><b1>1e-4</b1></ModPhgrStd></CalibDistortion></CalibrationInternConique></ExportAPERO>"
        }
        "synth_0.out" => {
            "drews 1.0\n2 1\n0 0 0\n0 0 0\n0 0 0\n0 0 0\n0 0 0\n0.9 0.1 0.2\n1 0 0\n0 1 0\n0 0 1\n0 0 5\n1 2 3\n10 20 30\n2 0 1 0 1 5 0\n"
        }
        _ => return mvs().write(),
    };
    text.as_bytes().to_vec()
}

/// An OpenMVS scene with two images, one of them calibrated, and one point.
fn mvs() -> openmvs::Mvs {
    let unit = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    let image = |name: &str, id, pose| openmvs::Image {
        name: name.into(),
        mask: Vec::new(),
        platform: 0,
        camera: 0,
        pose,
        id,
        depths: [1.0; 3],
        view_scores: Vec::new(),
    };
    let k = [90.0, 0.0, 49.5, 0.0, 90.0, 39.5, 0.0, 0.0, 1.0];
    let camera = openmvs::Camera {
        width: 100,
        height: 80,
        k,
        r: unit,
        ..openmvs::Camera::default()
    };
    let poses = vec![openmvs::PlatformPose {
        r: unit,
        c: [1.0, 2.0, 3.0],
    }];
    openmvs::Mvs {
        platforms: vec![openmvs::Platform {
            name: b"p".to_vec(),
            cameras: vec![camera],
            poses,
        }],
        images: vec![image("a.jpg", 3, 0), image("b.jpg", 4, openmvs::NO_POSE)],
        vertices: vec![openmvs::Vertex {
            x: [1.0, 2.0, 9.0],
            views: vec![openmvs::VertexView {
                image: 0,
                confidence: 1.0,
            }],
        }],
        colours: vec![[1, 2, 3]],
        ..openmvs::Mvs::default()
    }
}

/// Reads a model file of another program and checks the result.
pub fn read_foreign(name: &str, data: &[u8]) {
    let size = |_: &str| Some((100, 80));
    let found = match name {
        "bundle.out" => bundler::read(data, b"a.jpg\nb.jpg\n", &size),
        "model.nvm" => nvm::read(data, &|_| None),
        "sfm_data.json" => openmvg::read(data),
        "reconstruction.json" => opensfm::read(data, Some(b"a.jpg\t17\t0\t0.1\t0.1\n")),
        "scene.sfm" => alicevision::read(data),
        "transforms.json" => {
            transforms::read(data, &size, &str::to_owned).map(|(foreign, _)| foreign)
        }
        "cameras.xml" => metashape::read(data, [Frame::World], &str::to_owned).map(|[model]| model),
        "block.xml" => blocks::read(data).map(|mut foreign| {
            foreign.shorten_names();
            foreign
        }),
        "Orientation-a.jpg.xml" | "AutoCal.xml" => micmac_model(name, data),
        "synth_0.out" => {
            let meta =
                |id: u32| format!("[camera]\nprincipal_point = 0.5 0.5\n[view]\nid = {id}\n");
            let views = [0, 1]
                .map(|id| mve::View::read(&meta(id), format!("view_000{id}.mve/undistorted.jpg")));
            mve::read(data, &views.map(|view| view.expect("it has an id")), &size)
        }
        "image.ori" => {
            sure::read(data, 1).map(|orientation| sure::model(vec![orientation], str::to_owned))
        }
        _ => openmvs::Mvs::read(data).and_then(|mvs| mvs.model(&size)),
    };
    match found.and_then(|foreign| Ok((foreign.scene()?, foreign))) {
        Ok((scene, foreign)) => check(&foreign.model, &scene),
        Err(fault) => {
            assert!(!fault.to_string().is_empty() && !fault.problem.hint().to_string().is_empty())
        }
    }
}

/// A model of MicMac with the file of that name replaced.
fn micmac_model(name: &str, data: &[u8]) -> Result<ForeignModel, Fault> {
    let file = |of: &str| {
        if name == of {
            data.to_vec()
        } else {
            foreign_model(of)
        }
    };
    let (camera, _) = micmac::read_calibration(&file("AutoCal.xml"), 1)?;
    let cam_from_world = micmac::read_orientation(&file("Orientation-a.jpg.xml"))?.cam_from_world;
    Ok(sure::model(
        vec![sure::Orientation {
            image: "a.jpg".into(),
            camera,
            cam_from_world,
        }],
        str::to_owned,
    ))
}

/// A COLMAP model: three images, a rig of two cameras, a third camera, and four points.
pub fn model(text: bool) -> Files {
    const CAMERAS: &[u8] =
        b"1 OPENCV 100 80 90 91 50 40 0.01 0.02 0 0\n2 SIMPLE_RADIAL 100 80 90 50 40 0.1\n9 PINHOLE 10 8 9 9 5 4\n";
    const IMAGES: &[u8] = b"1 1 0 0 0 0 0 0 1 a.jpg\n1 2 7 3 4 -1 5 6 9\n2 1 0 0 0 1 0 0 2 b.jpg\n1 2 7 3 4 8\n7 0 1 0 0 0 0 3 1 sub/c.jpg\n1 2 10 3 4 9\n";
    const POINTS: &[u8] =
        b"7 0 0 5 10 20 30 0.5 1 0 2 0\n8 1 0 5 10 20 30 -1 2 1\n9 1 1 5 1 2 3 0.5 1 2 7 1\n10 2 0 5 1 2 3 0.25 7 0\n";
    const RIGS: &[u8] = b"1 2 CAMERA 1 CAMERA 2 1 1 0 0 0 1 0 0\n2 1 CAMERA 9\n";
    const FRAMES: &[u8] =
        b"1 1 1 0 0 0 0 0 0 2 CAMERA 1 1 CAMERA 2 2\n2 1 0 1 0 0 0 0 3 1 CAMERA 1 7\n";
    let bytes = Bytes {
        cameras: CAMERAS,
        images: IMAGES,
        points3d: POINTS,
        rigs: Some(RIGS),
        frames: Some(FRAMES),
    };
    let model = colmap_text::read(&bytes).expect("the model is valid");
    if text {
        colmap_text::write(&model).expect("no blanks in names")
    } else {
        colmap_bin::write(&model)
    }
}

/// Reads the model with the file `target` replaced by `data`, and checks the result.
pub fn replace(target: &str, data: &[u8], files: &Files) {
    let file = |name: &str| {
        let stem_matches = |f: &&(&str, Vec<u8>)| f.0.split('.').next() == Some(name);
        let found = files
            .iter()
            .find(stem_matches)
            .expect("the model has every file");
        if found.0 == target { data } else { &found.1 }
    };
    let bytes = Bytes {
        cameras: file("cameras"),
        images: file("images"),
        points3d: file("points3D"),
        rigs: Some(file("rigs")),
        frames: Some(file("frames")),
    };
    // Also without rigs and frames: fewer contradictions, so more inputs are read to the end.
    for bytes in [
        bytes,
        Bytes {
            rigs: None,
            frames: None,
            ..bytes
        },
    ] {
        match read(&bytes, target.ends_with("txt")) {
            Ok((model, scene)) => check(&model, &scene),
            Err(fault) => {
                assert!(
                    !fault.to_string().is_empty() && !fault.problem.hint().to_string().is_empty()
                )
            }
        }
    }
}

fn read<'a>(bytes: &Bytes<'a>, text: bool) -> Result<(ColmapModel<'a>, Scene), Fault> {
    let model = if text {
        colmap_text::read(bytes)?
    } else {
        colmap_bin::read(bytes)?
    };
    let scene = model.scene()?;
    Ok((model, scene))
}

fn check(model: &ColmapModel, scene: &Scene) {
    assert_eq!(
        (scene.views.len(), scene.points.len()),
        (model.images.len(), model.points.len())
    );
    assert!(scene.views.is_sorted_by(|a, b| a.name < b.name));
    assert_eq!(scene.track_offsets.len(), scene.points.len() + 1);
    assert!(scene.track_offsets.is_sorted());
    assert_eq!(
        *scene.track_offsets.last().unwrap(),
        scene.track_views.len()
    );
    assert_eq!(scene.track_pixels.len(), scene.track_views.len());
    assert!(
        scene
            .track_views
            .iter()
            .all(|v| v.index() < scene.views.len())
    );
    assert!(scene.track_pixels.iter().flatten().all(|c| c.is_finite()));
    assert!(scene.points.iter().all(|p| p.iter().all(|c| c.is_finite())));
    for view in &scene.views {
        let rotation = view.cam_from_world.rotation.matrix();
        assert!((rotation.determinant() - 1.0).abs() < 1e-9, "{rotation}");
        assert!(view.camera.index() < scene.cameras.len());
    }
    let _ = (scene.median_gsd(), scene.mean_reprojection_error());
    assert_round_trip(scene, &colmap_bin::write(model), false);
    if let Ok(files) = colmap_text::write(model) {
        assert_round_trip(scene, &files, true);
    }
    let use_of = |image: &ColmapImage| match image.id % 3 {
        0 => ImageUse::Removed,
        1 => ImageUse::Counting,
        _ => ImageUse::Kept,
    };
    let reduced = model
        .reduced(use_of, 2)
        .expect("a valid model can be reduced");
    reduced.scene().expect("a reduced model is consistent");
}

/// Checks that the written files give the same scene.
fn assert_round_trip(scene: &Scene, files: &Files, text: bool) {
    let file = |name: &str| {
        files
            .iter()
            .find(|f| f.0.split('.').next() == Some(name))
            .map(|f| &f.1[..])
    };
    let required = |name| file(name).expect("written");
    let (rigs, frames) = (file("rigs"), file("frames"));
    let bytes = Bytes {
        cameras: required("cameras"),
        images: required("images"),
        points3d: required("points3D"),
        rigs,
        frames,
    };
    let (_, other) = read(&bytes, text).expect("a written model can be read");
    assert_eq!(
        (&other.cameras, &other.points, &other.point_ids),
        (&scene.cameras, &scene.points, &scene.point_ids)
    );
    assert_eq!(
        (&other.track_views, &other.track_pixels),
        (&scene.track_views, &scene.track_pixels)
    );
    let views = |s: &Scene| {
        s.views
            .iter()
            .map(|v| (v.name.clone(), v.image_id, v.cam_from_world))
            .collect::<Vec<_>>()
    };
    assert_eq!(views(&other), views(scene));
}
