//! A version that a session uses is not garbage-collected, however old it is.

use std::time::Duration;

use wildcity_twin::store::{Catalog, Retention};

use crate::support::{TEST_TIMEOUT, TestServer, commit_twin_with_opacity};

#[tokio::test]
async fn a_version_that_a_session_sees_is_kept() {
    let server = TestServer::start().await;
    let mut agent = server.driver("a").await;
    let catalog = Catalog::open(server.twins.path()).unwrap();
    commit_twin_with_opacity(server.twins.path(), 1.0);
    let keep = Retention { versions: 1, grace: Duration::ZERO };
    for _ in 0..2 {
        assert_eq!(catalog.collect("test", keep, false).unwrap().kept, [1, 2]);
    }
    agent.step(1.0).await;
    server.running.stop().await;
    // The last task of the server may hold the lease for a moment longer.
    let ended = async {
        while catalog.collect("test", keep, true).unwrap().kept != [2] {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    tokio::time::timeout(TEST_TIMEOUT, ended).await.expect("the lease ends");
}
