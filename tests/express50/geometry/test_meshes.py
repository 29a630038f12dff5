"""Edges, open edges and connected parts of small meshes that can be checked by hand."""

import numpy as np

from express50.geometry.meshes import edge_graph, edges_of, mesh_parts, open_edges

# A square of two triangles, and a triangle apart from it; no face has vertex 7.
FACES = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]])


def test_edges_run_as_their_faces_do():
    assert edges_of(FACES[:1]).tolist() == [[0, 1], [1, 2], [2, 0]]


def test_open_edges_are_those_of_one_face():
    rim = [[0, 1], [3, 0], [1, 2], [2, 3], [4, 5], [6, 4], [5, 6]]  # by their sorted vertices
    assert open_edges(FACES).tolist() == rim


def test_the_graph_counts_shared_edges_once():
    graph = edge_graph(FACES, 8).toarray()
    assert (graph == graph.T).all() and set(graph.ravel()) == {0.0, 1.0}
    assert graph[0].nonzero()[0].tolist() == [1, 2, 3] and graph.sum() == 2 * (5 + 3)


def test_parts_are_numbered_by_their_first_vertex():
    assert mesh_parts(FACES, 8).tolist() == [0, 0, 0, 0, 1, 1, 1, 2]
