//! Which jobs a list has.

use super::*;
use crate::jobs::labels;

in_homes! { [on_sqlite on_postgres] [
    jobs_are_found_by_their_labels_and_age,
] }

async fn jobs_are_found_by_their_labels_and_age(home: Home) {
    let [store]: [Store; 1] = home.servers().await;
    add_mesh(&store, "mesh").await;
    let labels = |texts: &[&str]| texts.iter().map(|text| labels::parse(text).unwrap()).collect();
    let mut created_ms = Vec::new();
    for (id, texts) in [("a", vec!["x=1", "y=2"]), ("b", vec!["x=1"]), ("c", vec!["y=2", "z="])] {
        let new = NewJob { labels: labels(&texts), ..new_job("") };
        let (job, _) = store.create(id, &new, &queue_of(9)).await.unwrap();
        assert_eq!(job.labels, new.labels);
        created_ms.push(job.created_ms);
        tokio::time::sleep(Duration::from_millis(3)).await;
    }
    let found = async |filter: Filter, before: Option<i64>| -> String {
        let jobs = store.list(&filter, before, 9).await.unwrap();
        jobs.into_iter().map(|job| job.id).collect()
    };
    let rows: [(&[&str], &str); 7] = [
        (&[], "cba"),
        (&["x=1"], "ba"),
        (&["y=2"], "ca"),
        (&["x=1", "y=2"], "a"),
        (&["z="], "c"),
        (&["z=1"], ""),
        (&["x=1", "z="], ""),
    ];
    for (texts, wanted) in rows {
        let filter = Filter { labels: labels(texts), ..Filter::default() };
        assert_eq!(found(filter, None).await, wanted, "{texts:?}");
    }
    let both = Filter {
        owner: Some(LOCAL.into()),
        states: vec![State::Running, State::Queued],
        labels: labels(&["x=1"]),
        created_ms: (None, None),
    };
    assert_eq!(found(both.clone(), None).await, "ba");
    assert_eq!(found(both, Some(2)).await, "a");
    let [a, b, c] = created_ms[..] else { panic!("{created_ms:?}") };
    for (from, until, wanted) in
        [(Some(b), None, "cb"), (None, Some(b), "a"), (Some(a + 1), Some(c), "b")]
    {
        let filter = Filter { created_ms: (from, until), ..Filter::default() };
        assert_eq!(found(filter, None).await, wanted);
    }
    // They go with their job.
    store.cancel("a").await.unwrap();
    store.delete("a").await.unwrap();
    let n: i64 =
        sqlx::query_scalar("SELECT count(*) FROM labels").fetch_one(&store.readers).await.unwrap();
    assert_eq!(n, 3);
}
