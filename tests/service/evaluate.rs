//! The job that compares two meshes: what `compare` says on the same machine, from a server.

use std::{fs, process::Output};

use lookalike::{
    jobs::{
        event::{Body, Report},
        spec::{Evaluate, Input, Spec},
        state::State,
    },
    service::{
        convert::{mesh_hash, spec_to_wire},
        proto::v1,
        status::faults_of,
    },
};
use serde_json::{Value, json};
use tonic::Code;

use crate::{
    support::{
        Client, Server, create, ended, eventually, job, log, lookalike, small_torus, state, torus,
        upload,
    },
    web::Web,
};

async fn evaluated(client: &mut Client, original: Vec<u8>, simplified: Vec<u8>) -> String {
    let (original, simplified) = (upload(client, original).await, upload(client, simplified).await);
    let input = Input { mesh: mesh_hash(&simplified), file_name: "crude.ply".into() };
    let request = v1::CreateJobRequest {
        request_id: String::new(),
        mesh: original,
        file_name: "torus.ply".into(),
        spec: Some(spec_to_wire(&Spec::evaluating(input, Evaluate::default()))),
        webhook_url: String::new(),
        priority: 0,
        labels: std::collections::HashMap::new(),
    };
    client.create_job(request).await.unwrap().into_inner().job.unwrap().name
}

fn printed(output: Output) -> String {
    assert!(output.status.success(), "{output:?}");
    String::from_utf8(output.stdout).unwrap()
}

#[tokio::test]
async fn the_job_says_what_compare_says() {
    let server = Server::start();
    let (file, crude) =
        (server.file("torus.ply", &small_torus()), server.file("crude.ply", &torus(16, 12)));
    let [here, there, out] =
        ["here.png", "there.png", "out"].map(|f| server.dir.path().join(f).display().to_string());
    let looks = ["--shading=smooth", "--colours", "--hide-back-faces", "--stored-normals"];
    for flags in [&["--json"][..], &[], &[&looks[..], &["--no-distance", "--json"]].concat()] {
        let flags = [&[&*file, &crude], flags].concat();
        let local = lookalike().arg("compare").args(&flags).args(["--sheet", &here]).output();
        let local = printed(local.unwrap());
        let remote = [&flags[..], &["--remote", "--sheet", &there]].concat();
        assert_eq!(printed(server.run("compare", &remote)), local, "{flags:?}");
        assert!(fs::read(&here).unwrap() == fs::read(&there).unwrap(), "{flags:?}");
        assert!(local.contains("d2"), "{local}");
    }
    // Several are a job each, in the order named.
    let two = [&*file, &crude, &file, "--json", "--no-distance"];
    let local = printed(lookalike().arg("compare").args(two).output().unwrap());
    assert_eq!(printed(server.run("compare", &[&two[..], &["--remote"]].concat())), local);
    let sheet = server.run("compare", &[&two[..], &["--remote", "--sheet", &there]].concat());
    assert_eq!(sheet.status.code(), Some(2), "{sheet:?}");

    // By the API: the same file, byte for byte, and a line in the log.
    let mut client = server.client();
    let name = evaluated(&mut client, small_torus(), torus(16, 12)).await;
    let done = ended(&client, &name).await;
    assert_eq!(state(&done), State::Succeeded, "{done:?}");
    let Some(v1::job_spec::Kind::Evaluate(asked)) = done.spec.and_then(|s| s.kind) else {
        panic!("the kind of {name}");
    };
    assert_eq!((&*asked.simplified_file_name, asked.distance), ("crude.ply", Some(true)));
    let said = log(&mut client, &name, 0)
        .await
        .into_iter()
        .any(|e| matches!(e.body, Body::Worker(Report::Note { code, .. }) if code == "COMPARED"));
    assert!(said);
    printed(server.run("fetch", &[&name, "--out", &out]));
    let local = printed(lookalike().args(["compare", &file, &crude, "--json"]).output().unwrap());
    let folder = server.dir.path().join("out");
    assert_eq!(fs::read_to_string(folder.join("comparison.json")).unwrap(), local);
    let report: Value =
        serde_json::from_slice(&fs::read(folder.join("report.json")).unwrap()).unwrap();
    assert_eq!(report["comparison"], serde_json::from_str::<Value>(&local).unwrap());
    let listed = printed(server.run("jobs", &["--limit=1"]));
    assert!(listed.contains("evaluate crude.ply  torus.ply"), "{listed}");
    let listed: Value =
        serde_json::from_str(&printed(server.run("jobs", &["--limit=1", "--json"]))).unwrap();
    assert_eq!(listed["spec"]["evaluate"]["distance"], true);
}

#[tokio::test]
async fn what_does_not_fit_is_told_by_its_name() {
    let server = Server::start_with(&["--workers=0"]);
    let mut client = server.client();
    let mesh = upload(&mut client, small_torus()).await;
    let evaluate = v1::EvaluateSpec {
        simplified_mesh: format!("meshes/{}", "0".repeat(64)),
        simplified_file_name: "../crude.ply".into(),
        shading: 99,
        ..Default::default()
    };
    let kind = Some(v1::job_spec::Kind::Evaluate(evaluate));
    let (file_name, spec) = ("torus.ply".into(), Some(v1::JobSpec { kind }));
    let request =
        v1::CreateJobRequest { mesh: mesh.clone(), file_name, spec, ..Default::default() };
    let status = client.create_job(request).await.unwrap_err();
    assert_eq!(status.code(), Code::InvalidArgument);
    let mut fields: Vec<_> = faults_of(&status).into_iter().map(|f| f.field).collect();
    fields.sort();
    let wanted = ["shading", "simplified_file_name", "simplified_mesh"];
    assert_eq!(fields, wanted.map(|field| format!("spec.evaluate.{field}")));

    // JSON is read strictly: what belongs to other kinds of jobs is refused by name.
    let web = Web::new(&server, None);
    let ask = async |misfit: Option<(&str, Value)>| {
        let mut evaluate = json!({"simplifiedMesh": mesh, "simplifiedFileName": "crude.ply"});
        evaluate.as_object_mut().unwrap().extend(misfit.map(|(k, v)| (k.to_owned(), v)));
        let spec = json!({"evaluate": evaluate});
        let body = json!({"mesh": mesh, "fileName": "torus.ply", "spec": spec});
        let answer = web.post("/api/v1/jobs", body).await;
        (answer.status().as_u16(), answer.text().await.unwrap())
    };
    for (field, value) in [
        ("triangles", json!([500])),
        ("effort", json!("EFFORT_BEST")),
        ("optimization", json!({"maxEvaluations": "9"})),
        ("maxSecs", json!(9)),
        ("seed", json!("7")),
        ("shading", json!("SHADING_ROUGH")),
    ] {
        let (code, text) = ask(Some((field, value))).await;
        let names_it = text.contains(field) || text.contains("SHADING_ROUGH");
        assert!(code == 400 && names_it, "{field}: {code}: {text}");
    }
    let (code, text) = ask(Some(("shading", json!("SHADING_SMOOTH")))).await;
    assert_eq!(code, 200, "{text}");
    let made: Value = serde_json::from_str(&text).unwrap();
    let asked = &made["job"]["spec"]["evaluate"];
    assert_eq!((&asked["shading"], &asked["distance"]), (&json!("SHADING_SMOOTH"), &json!(true)));
}

#[tokio::test]
async fn it_is_cancelled_while_it_computes_and_a_bad_mesh_is_named() {
    let server = Server::start();
    let mut client = server.client();
    let name = evaluated(&mut client, torus(500, 500), torus(400, 400)).await;
    eventually("pictures", || async {
        let job = job(&mut client.clone(), &name).await;
        assert!(!state(&job).is_final(), "{job:?}");
        (job.stage == "pictures").then_some(())
    })
    .await;
    let cancelled = server.run("cancel", &[&name]);
    assert!(cancelled.status.success(), "{cancelled:?}");
    assert_eq!(state(&ended(&client, &name).await), State::Cancelled);

    for (original, simplified, wanted) in [
        (small_torus(), b"ply".to_vec(), "the simplified mesh, crude.ply: "),
        (b"ply".to_vec(), small_torus(), "the original, torus.ply: "),
    ] {
        let name = evaluated(&mut client, original, simplified).await;
        let failed = ended(&client, &name).await;
        assert_eq!(state(&failed), State::Failed);
        let failure = failed.failure.unwrap();
        assert!(failure.text.starts_with(wanted) && !failure.reason.is_empty(), "{failure:?}");
        assert_eq!(failed.attempt, 1);
    }
    // The worker is as good as new.
    let next = create(&mut client).await;
    assert_eq!(state(&ended(&client, &next).await), State::Succeeded);
}
