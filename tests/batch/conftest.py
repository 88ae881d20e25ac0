"""What tests of clusters share."""

import pytest

from equipix.batch.cluster import SETTINGS


@pytest.fixture(scope="module")
def cluster():
    """Two worker processes of one thread each."""
    distributed = pytest.importorskip("distributed")
    with (
        pytest.importorskip("dask").config.set(SETTINGS),
        distributed.LocalCluster(
            n_workers=2,
            threads_per_worker=1,
            dashboard_address="127.0.0.1:0",
            memory_limit=0,
            resources={"equipix-memory": 2e9},
        ) as cluster,
    ):
        yield cluster
