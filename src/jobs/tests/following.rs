//! Followers of logs.

use super::*;

in_homes! { [on_sqlite on_postgres] [
    followers_see_everything_live_wherever_they_begin,
    followers_at_the_same_place_share_a_page,
] }

async fn followers_see_everything_live_wherever_they_begin(home: Home) {
    let jobs = home.open().await;
    let id = create(&jobs).await.id;
    let live = jobs.follow("reader", &id, 0).try_collect::<Vec<_>>();
    let work = async {
        let (_, lease) = claim(&jobs, "w").await.unwrap();
        for first in 0..20 {
            let bytes = vec![first as u8; 100];
            let records = Report::Records { level: None, first, count: 1, bytes };
            jobs.append(&lease, first, vec![records]).await.unwrap();
        }
        jobs.complete(&lease, &Outcome::Failed("BAD".into(), "bad".into())).await.unwrap();
    };
    let (live, ()) = tokio::join!(live, work);
    let live = live.unwrap();
    assert_eq!(live.last().unwrap().body.state(), Some(State::Failed));
    for after in 0..live.len() {
        let rest: Vec<_> = jobs.follow("reader", &id, after as u64).try_collect().await.unwrap();
        assert_eq!(rest, live[after..]);
    }
    let past: Vec<_> = jobs.follow("reader", &id, u64::MAX).try_collect().await.unwrap();
    assert_eq!(past, []);
    let missing = jobs.follow("reader", "none", 0).try_collect::<Vec<_>>().await;
    assert!(matches!(missing, Err(Error::NotFound(_))));
}

async fn followers_at_the_same_place_share_a_page(home: Home) {
    let jobs = home.open().await;
    let id = create(&jobs).await.id;
    let (_, lease) = claim(&jobs, "w").await.unwrap();
    // Two full pages, and some entries.
    jobs.append(&lease, 0, (0..600).map(|i| note(&i.to_string())).collect()).await.unwrap();
    jobs.complete(&lease, &Outcome::Failed("BAD".into(), "bad".into())).await.unwrap();
    let stored = jobs.entries(&id, 0, 1000).await.unwrap();
    let mut first = Box::pin(jobs.follow("ann", &id, 0));
    let mut second = Box::pin(jobs.follow("bob", &id, 0));
    for log in [&mut first, &mut second] {
        assert_eq!(log.try_next().await.unwrap().unwrap(), stored[0]);
    }
    let page = jobs.0.pages.get(&format!("{id}/0")).unwrap();
    assert_eq!(Arc::strong_count(&page), 4, "the two, what is kept, and this");
    for log in [first, second] {
        assert_eq!(log.try_collect::<Vec<_>>().await.unwrap(), stored[1..]);
    }
    // Wherever they begin, after others have been there.
    for after in [0, 1, 100, 255, 256, 257, 512, 599, 602] {
        let rest: Vec<_> = jobs.follow("ann", &id, after as u64).try_collect().await.unwrap();
        assert_eq!(rest, stored[after..]);
    }
}
