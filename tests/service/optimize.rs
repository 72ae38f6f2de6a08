//! The job that optimizes a mesh which something else has simplified: two inputs, one result.

use std::fs;

use lookalike::{
    jobs::{
        event::{Body, Report},
        spec::{Input, Optimize, Spec},
        state::State,
    },
    service::{
        convert::{mesh_hash, spec_to_wire},
        proto::{v1, worker::v1 as wire},
        status::faults_of,
    },
};
use tonic::Code;

use crate::support::{Server, ended, job_spec, log, small_torus, state, torus, upload};

/// Of the small torus, with a coarser torus in its place.
fn request(original: &str, simplified: &str) -> v1::CreateJobRequest {
    let input = Input { mesh: mesh_hash(simplified), file_name: "crude.ply".into() };
    let optimize = Optimize { max_evaluations: Some(12_000), ..Optimize::default() };
    let spec = Spec { render: job_spec().render, optimize, ..Spec::optimizing(input) };
    v1::CreateJobRequest {
        request_id: String::new(),
        mesh: original.into(),
        file_name: "torus.ply".into(),
        spec: Some(spec_to_wire(&spec)),
        webhook_url: String::new(),
        priority: 0,
        labels: std::collections::HashMap::new(),
    }
}

#[tokio::test]
async fn a_mesh_from_elsewhere_is_optimized() {
    let server = Server::start();
    let mut client = server.client();
    let original = upload(&mut client, small_torus()).await;
    let simplified = upload(&mut client, torus(16, 12)).await;
    let created = client.create_job(request(&original, &simplified)).await.unwrap();
    let name = created.into_inner().job.unwrap().name;
    let done = ended(&client, &name).await;
    assert_eq!(state(&done), State::Succeeded, "{done:?}");
    let log = log(&mut client, &name, 0).await;
    let has = |wanted: fn(&Report) -> bool| {
        log.iter().any(|e| matches!(&e.body, Body::Worker(report) if wanted(report)))
    };
    assert!(has(|r| matches!(r, Report::Records { level: Some(0), .. })));
    assert!(has(|r| matches!(r, Report::Moves { level: 0, .. })));
    assert!(has(|r| matches!(r, Report::Sample(s) if s.energy_ratio.is_some_and(|e| e < 1.0))));
    // The same from the command line, and the same bytes without a server.
    let (file, crude) =
        (server.file("torus.ply", &small_torus()), server.file("crude.ply", &torus(16, 12)));
    let [here, there] = ["here", "there"].map(|dir| server.dir.path().join(dir));
    for (out, remote) in [(&here, false), (&there, true)] {
        let out = out.display().to_string();
        let mut flags = vec![&*file, &crude, "--out", &out, "--device=cpu", "--views=12"];
        flags.extend(["--image-size=128", "--optimize-evaluations=12000"]);
        flags.extend(remote.then_some("--remote"));
        let output = server.run("optimize", &flags);
        assert!(output.status.success(), "{output:?}");
    }
    for file in ["lod-0.glb", "progressive.lkpm"] {
        assert_eq!(fs::read(here.join(file)).unwrap(), fs::read(there.join(file)).unwrap());
    }
}

#[tokio::test]
async fn what_is_wrong_with_the_second_input_is_told_by_its_name() {
    let server = Server::start_with(&["--workers=0"]);
    let mut client = server.client();
    let original = upload(&mut client, small_torus()).await;
    let absent = format!("meshes/{}", "0".repeat(64));
    let mut request = request(&original, &absent);
    let kind = request.spec.as_mut().and_then(|s| s.kind.as_mut());
    let Some(v1::job_spec::Kind::Optimize(spec)) = kind else { panic!("{request:?}") };
    spec.simplified_file_name = "../crude.ply".into();
    spec.optimization.as_mut().unwrap().until = Some(2.0);
    let status = client.create_job(request).await.unwrap_err();
    assert_eq!(status.code(), Code::InvalidArgument);
    let fields: Vec<_> = faults_of(&status).into_iter().map(|f| f.field).collect();
    let wanted = ["simplified_mesh", "simplified_file_name", "optimization.until"];
    assert_eq!(fields, wanted.map(|field| format!("spec.optimize.{field}")));
}

#[tokio::test]
async fn a_worker_gets_the_inputs_of_its_job_and_no_others() {
    let server = Server::start_with(&["--workers=0"]);
    let mut client = server.client();
    let original = upload(&mut client, small_torus()).await;
    let simplified = upload(&mut client, torus(16, 12)).await;
    let stranger = upload(&mut client, torus(10, 10)).await;
    client.create_job(request(&original, &simplified)).await.unwrap();
    let mut worker = server.worker_client();
    let claim = wire::ClaimRequest {
        worker: "w".into(),
        version: env!("CARGO_PKG_VERSION").into(),
        wait_secs: 5.0,
        build: String::new(),
        host: String::new(),
    };
    let lease = worker.claim(claim).await.unwrap().into_inner().assignment.unwrap().lease;
    let mut fetch = async |mesh: &str| {
        let request = wire::FetchMeshRequest { lease: lease.clone(), mesh: mesh.into() };
        let mut chunks = worker.fetch_mesh(request).await?.into_inner();
        let mut bytes = Vec::new();
        while let Some(chunk) = chunks.message().await? {
            bytes.extend_from_slice(&chunk.data);
        }
        Ok::<_, tonic::Status>(bytes)
    };
    assert_eq!(fetch("").await.unwrap(), small_torus());
    assert_eq!(fetch(&original).await.unwrap(), small_torus());
    assert_eq!(fetch(&simplified).await.unwrap(), torus(16, 12));
    assert_eq!(fetch(&stranger).await.unwrap_err().code(), Code::InvalidArgument);
}
