// Which Gaussians touch which tile, nearest first.
#pragma once

#include <cstdint>
#include <cstring>
#include <type_traits>
#include <vector>

constexpr int kTile = 16;

// Pixels [x0, x1) x [y0, y1) that a Gaussian can reach; empty when it is not visible.
struct Box {
    int32_t x0, y0, x1, y1;
    bool empty() const { return x1 <= x0 || y1 <= y0; }
    int tile_x0() const { return x0 / kTile; }
    int tile_y0() const { return y0 / kTile; }
    int tile_x1() const { return (x1 - 1) / kTile + 1; }
    int tile_y1() const { return (y1 - 1) / kTile + 1; }
    int64_t tiles() const {
        return empty() ? 0 : int64_t(tile_x1() - tile_x0()) * (tile_y1() - tile_y0());
    }
};

// Indices of the visible Gaussians by depth; equal depths keep the order of their indices.
// Radix sort, 11 bits a pass: positive floats sort as their bit patterns do.
template <class Real>
std::vector<int32_t> order_by_depth(int64_t n, const Real* depths, const Box* boxes) {
    using Key = std::conditional_t<sizeof(Real) == 4, uint32_t, uint64_t>;
    struct Item {
        Key key;
        int32_t id;
    };
    std::vector<Item> items, sorted;
    items.reserve(n);
    for (int64_t i = 0; i < n; ++i) {
        if (boxes[i].empty()) continue;
        Item item{0, int32_t(i)};
        std::memcpy(&item.key, &depths[i], sizeof(Key));
        items.push_back(item);
    }
    sorted.resize(items.size());
    constexpr int kBits = 11, kBuckets = 1 << kBits;
    for (int shift = 0; shift < int(sizeof(Key)) * 8; shift += kBits) {
        std::vector<int64_t> start(kBuckets + 1, 0);
        for (const Item& item : items) ++start[((item.key >> shift) & (kBuckets - 1)) + 1];
        for (int b = 0; b < kBuckets; ++b) start[b + 1] += start[b];
        for (const Item& item : items) sorted[start[(item.key >> shift) & (kBuckets - 1)]++] = item;
        items.swap(sorted);
    }
    std::vector<int32_t> order(items.size());
    for (size_t i = 0; i < items.size(); ++i) order[i] = items[i].id;
    return order;
}

// Fills ids with the Gaussians of each tile, nearest first; those of tile i are
// ids[starts[i]] .. ids[starts[i + 1] - 1]. `starts` has one entry more than there are tiles.
template <class Real>
void bin_into_tiles(int64_t n, const Real* depths, const Box* boxes, int columns, int rows,
                    int64_t* starts, int32_t* ids) {
    const int64_t tiles = int64_t(columns) * rows;
    std::vector<int64_t> cursor(tiles + 1, 0);
    auto for_each_tile = [&](const Box& box, auto&& visit) {
        for (int y = box.tile_y0(); y < box.tile_y1(); ++y)
            for (int x = box.tile_x0(); x < box.tile_x1(); ++x) visit(int64_t(y) * columns + x);
    };
    for (int64_t i = 0; i < n; ++i)
        if (!boxes[i].empty()) for_each_tile(boxes[i], [&](int64_t tile) { ++cursor[tile + 1]; });
    for (int64_t i = 0; i < tiles; ++i) cursor[i + 1] += cursor[i];
    std::memcpy(starts, cursor.data(), sizeof(int64_t) * (tiles + 1));
    for (int32_t id : order_by_depth(n, depths, boxes))
        for_each_tile(boxes[id], [&](int64_t tile) { ids[cursor[tile]++] = id; });
}
