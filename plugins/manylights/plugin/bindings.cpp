/**
 * manylights._core: the light tree and the resampling in plain float, for tests, teaching
 * and plots. It is the code that the plugins run (the same headers), without a scene.
 *
 * Lights are numbered as in the input, whatever order the tree gives them.
 */

#include "manylights/choice/group_names.h"
#include "manylights/choice/parameter_table.h"
#include "manylights/choice/reservoirs.h"
#include "manylights/choice/splitting.h"
#include "manylights/choice/systematic.h"
#include "manylights/emission/brightness_map.h"
#include "manylights/render/pass_plan.h"
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

namespace nb = nanobind;
using namespace nb::literals;
using namespace manylights;

namespace {

using Points  = nb::ndarray<const float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Numbers = nb::ndarray<const float, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using Place   = nb::ndarray<const float, nb::shape<3>, nb::c_contig, nb::device::cpu>;
using Rng     = drjit::PCG32<uint32_t>;

/// Lights and the probabilities with which they were chosen
using Choices = std::pair<std::vector<uint32_t>, std::vector<float>>;

Receiver<float> receiver(const Place &p, const Place &n, bool transmits) {
    auto at = drjit::zeros<Receiver<float>>();
    at.p    = { p(0), p(1), p(2) };
    at.n = at.wi = { n(0), n(1), n(2) };
    at.transmits = transmits;
    at.diffuse = at.alpha2 = 1.f;
    return at;
}

SplitFunction split_function(const std::string &name) {
    if (name == "near")
        return SplitFunction::Near;
    if (name == "far")
        return SplitFunction::Far;
    if (name == "variance")
        return SplitFunction::Variance;
    throw nb::value_error("split_function must be \"near\", \"far\" or \"variance\"");
}

class Tree {
public:
    Tree(const Points &mean, const Numbers &flux, const Points &axis,
         const Numbers &variance) {
        size_t count = flux.shape(0);
        if (mean.shape(0) != count || axis.shape(0) != count ||
            variance.shape(0) != count)
            throw nb::value_error(
                "mean, flux, axis and variance must have the same length");
        if (count == 0)
            throw nb::value_error("a tree needs at least one light");
        check_flux(flux);
        HostVector<LightBounds> bounds(count);
        for (size_t i = 0; i < count; ++i)
            bounds[i] = make_bounds(mean, flux(i), axis, variance(i), i);
        auto memory = [this](size_t nodes) {
            m_wide.resize(nodes);
            return m_wide.data();
        };
        m_tree = build_tree(std::move(bounds), memory, /* keep_binary = */ true);
        std::vector<LightRow> rows(count);
        m_light_of.resize(count);
        for (uint32_t i = 0; i < count; ++i) {
            rows[i].link                = m_tree.link[i];
            m_light_of[m_tree.order[i]] = i;
        }
        load_nodes();
        m_view.node_links = dr::load<dr::DynamicArray<uint32_t>>(m_tree.node_link.data(),
                                                                 m_tree.node_link.size());
        m_view.binary =
            load(m_tree.binary.data(), m_tree.binary.size() * kBinaryNodeFloats);
        m_view.rows        = load(rows.data(), count * kRowFloats);
        m_view.light_count = (uint32_t) count;
        m_view.directions  = Directions::Broad;
    }

    /// Probability that one random descent ends at each light
    std::vector<float> probabilities(const Place &p, const Place &n,
                                     bool transmits) const {
        auto at = receiver(p, n, transmits);
        TopWeights<float>(m_view, at);
        return for_each_light([&](uint32_t light) {
            return leaf_probability<float>(m_view, at, light, true);
        });
    }

    /// Systematic sampling: candidates for the random number u
    Choices candidates(const Place &p, const Place &n, float expected, float u,
                       uint64_t seed, bool transmits) const {
        auto at = receiver(p, n, transmits);
        TopWeights<float> top(m_view, at);
        return collect(SystematicCursor<float>(top, expected, u), at, seed);
    }

    /// Splitting of nodes for the random number xi
    Choices splitting_candidates(const Place &p, const Place &n, float rate, float xi,
                                 uint64_t seed, const std::string &function,
                                 bool transmits) const {
        auto at = receiver(p, n, transmits);
        return collect(
            SplittingCursor<float>(m_view, at, rate, xi, split_function(function)), at,
            seed);
    }

    /// Probability that each light is a candidate of that, given xi
    std::vector<float> splitting_probabilities(const Place &p, const Place &n, float rate,
                                               float xi, const std::string &function,
                                               bool transmits) const {
        auto at = receiver(p, n, transmits);
        SplittingCursor<float> cursor(m_view, at, rate, xi, split_function(function));
        return for_each_light([&](uint32_t light) {
            return cursor.inclusion_probability(m_view, at, light, true);
        });
    }

    /// Other fluxes for the 4-wide nodes, which keep their places
    void refit(const Numbers &flux) {
        if (flux.shape(0) != m_light_of.size())
            throw nb::value_error("flux must have one entry for each light");
        check_flux(flux);
        HostVector<float> ordered(m_light_of.size());
        for (uint32_t i = 0; i < ordered.size(); ++i)
            ordered[i] = flux(m_tree.order[i]);
        refit_tree(m_wide.data(), m_wide.size(), ordered);
        load_nodes();
    }

    uint32_t depth() const { return m_tree.depth; }
    size_t node_count() const { return m_wide.size(); }
    std::vector<uint32_t> order() const {
        return { m_tree.order.begin(), m_tree.order.end() };
    }
    nb::bytes nodes() const {
        return nb::bytes(m_wide.data(), m_wide.size() * sizeof(WideNode));
    }
    std::vector<uint32_t> node_links() const {
        return { m_tree.node_link.begin(), m_tree.node_link.end() };
    }
    nb::bytes binary_nodes() const {
        return nb::bytes(m_tree.binary.data(), m_tree.binary.size() * sizeof(BinaryNode));
    }

private:
    static void check_flux(const Numbers &flux) {
        for (size_t i = 0; i < flux.shape(0); ++i)
            if (!(flux(i) > 0) || !std::isfinite(flux(i)))
                throw nb::value_error("flux must be positive and finite");
    }

    static LightBounds make_bounds(const Points &mean, float flux, const Points &axis,
                                   float variance, size_t i) {
        LightBounds bounds;
        float extent = std::sqrt(3 * variance); // a box of this variance along each axis
        for (size_t k = 0; k < 3; ++k) {
            bounds.mean[k]    = mean(i, k);
            bounds.axis[k]    = axis(i, k);
            bounds.box_min[k] = mean(i, k) - extent;
            bounds.box_max[k] = mean(i, k) + extent;
        }
        bounds.variance = variance;
        bounds.flux     = flux;
        return bounds;
    }

    void load_nodes() {
        m_view.nodes = load(m_wide.data(), m_wide.size() * kWideNodeFloats);
        m_view.top   = TopView<float>(read_top(m_wide.data()));
    }

    static drjit::DynamicArray<float> load(const void *data, size_t size) {
        return drjit::load<drjit::DynamicArray<float>>(data, size);
    }

    template <typename Cursor>
    Choices collect(Cursor cursor, const Receiver<float> &at, uint64_t seed) const {
        Choices result;
        Rng rng(1, seed);
        while (cursor.has_next()) {
            Candidate<float> candidate = cursor.next(m_view, at, rng);
            if (!candidate.valid)
                continue;
            result.first.push_back(m_tree.order[candidate.light]);
            result.second.push_back(candidate.probability);
        }
        return result;
    }

    template <typename F> std::vector<float> for_each_light(const F &f) const {
        std::vector<float> result(m_light_of.size());
        for (size_t i = 0; i < result.size(); ++i)
            result[i] = f(m_light_of[i]);
        return result;
    }

    LightTree m_tree;
    std::vector<WideNode> m_wide;
    TreeView<float> m_view;
    std::vector<uint32_t> m_light_of;
};

/// Threshold-systematic selection: chosen items and their weights max(1, tau / g)
Choices select_items(const Numbers &targets, uint32_t picks, float offset) {
    size_t count = targets.shape(0);
    if (count > kMaxReservoirs || count == 0 || picks == 0)
        throw nb::value_error("select takes 1 to 64 targets and at least one pick");
    Slots<float> slots = make_slots<float>(count, 0.f);
    for (size_t i = 0; i < count; ++i)
        slots[i] = targets(i);
    float tau = selection_threshold<float>(slots, count, picks);
    Choices result;
    for (uint32_t i = 0; i < picks; ++i) {
        auto chosen = select_item<float>(slots, count, tau, (i + offset) * tau);
        if (!chosen.valid)
            continue;
        result.first.push_back(chosen.item);
        result.second.push_back(std::max(1.f, tau / chosen.target));
    }
    return result;
}

/// Stage 2 on candidates of importance h and probability p: held items and their C = W / H
Choices resample(const Numbers &importance, const Numbers &probability,
                 uint32_t reservoirs, bool greedy, uint64_t seed) {
    if (importance.shape(0) != probability.shape(0) || reservoirs == 0 ||
        reservoirs > kMaxReservoirs)
        throw nb::value_error(
            "resample takes arrays of one length and 1 to 64 reservoirs");
    Reservoirs<float> kept(reservoirs);
    Rng rng(1, seed);
    for (uint32_t i = 0; i < importance.shape(0); ++i)
        kept.add({ i, probability(i), true }, importance(i), reservoirs,
                 greedy ? Dealing::Greedy : Dealing::Random, rng);
    Choices result;
    for (uint32_t k = 0; k < reservoirs; ++k) {
        if (!(kept.weight[k] > 0))
            continue;
        result.first.push_back(kept.light[k]);
        result.second.push_back(kept.weight[k] / kept.importance[k]);
    }
    return result;
}

using Image = nb::ndarray<const float, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;
using Corners =
    nb::ndarray<const double, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;

BrightnessMap brightness_map(const Image &image, const std::string &wrap) {
    if (image.size() == 0 || (wrap != "repeat" && wrap != "mirror" && wrap != "clamp"))
        throw nb::value_error("an image has texels, and wrap is repeat, mirror or clamp");
    return { image.shape(1), image.shape(0),
             std::vector<float>(image.data(), image.data() + image.size()),
             wrap == "repeat"   ? Wrap::Repeat
             : wrap == "mirror" ? Wrap::Mirror
                                : Wrap::Clamp };
}

float mean_brightness(const BrightnessMap &map, const Corners &corners) {
    size_t count = corners.shape(0);
    if (count != 3 && count != 4)
        throw nb::value_error("corners must be those of a triangle or quadrilateral");
    Point2 polygon[4];
    for (size_t i = 0; i < count; ++i)
        polygon[i] = { corners(i, 0), corners(i, 1) };
    return map.mean(polygon, count);
}

/// The parameters of a plugin, for the test that compares them with what users are told
nb::list parameters(const std::string &plugin) {
    unsigned wanted = plugin == "manylights_direct" ? kDirect : kVolpath;
    nb::list result;
    for (const Parameter &each : parameter_table()) {
        if (!(each.plugins & wanted))
            continue;
        const char *types[] = { "bool", "int", "float", "string", "list" };
        std::vector<std::string> methods, texts(each.texts.begin(), each.texts.end());
        for (Method method : each.methods)
            methods.emplace_back(name_of(method));
        nb::dict about;
        about["name"]      = std::string(each.name);
        about["type"]      = types[(size_t) each.type];
        about["default"]   = each.text_of(each.fallback);
        about["low"]       = each.low;
        about["high"]      = each.high;
        about["high_name"] = std::string(each.high_name);
        about["texts"]     = texts;
        about["methods"]   = methods;
        about["meaning"]   = std::string(each.meaning);
        result.append(about);
    }
    return result;
}

/// The entry of a light with two names (how many there are, if it has none), and its group
std::pair<size_t, std::string> light_group(const std::string &groups,
                                           const std::string &name,
                                           const std::string &other) {
    GroupNames names(groups);
    size_t entry = names.entry_of(name, other);
    return { entry, names.groups()[names.group_of(entry)] };
}

std::vector<std::tuple<uint32_t, uint32_t, uint32_t>> learning_passes(uint32_t spp,
                                                                      uint64_t pixels) {
    if (spp == 0 || pixels == 0)
        throw nb::value_error("spp and pixels must be at least 1");
    std::vector<std::tuple<uint32_t, uint32_t, uint32_t>> result;
    for (const PlannedPass &pass : PassPlan::learning(spp, pixels, /* divides = */ false))
        result.emplace_back(pass.first, pass.count, (uint32_t) pass.role);
    return result;
}

} // namespace

NB_MODULE(_core, m) {
    m.doc() = "The light tree and the resampling in single precision, without a scene";
    nb::class_<Tree>(
        m, "Tree",
        "Light tree over N lights: mean positions (N, 3), flux (N), mean emission "
        "axes (N, 3; 0 for all directions) and variances of the position (N).")
        .def(nb::init<const Points &, const Numbers &, const Points &, const Numbers &>(),
             "mean"_a, "flux"_a, "axis"_a, "variance"_a)
        .def("probabilities", &Tree::probabilities, "p"_a, "n"_a, "transmits"_a = false,
             "Probability (N) that one random descent for a receiver ends at each light.")
        .def("candidates", &Tree::candidates, "p"_a, "n"_a, "expected"_a, "u"_a,
             "seed"_a = 0, "transmits"_a = false,
             "Systematic sampling with K = expected and the random number u: lights and "
             "the "
             "probabilities with which they are candidates.")
        .def("splitting_candidates", &Tree::splitting_candidates, "p"_a, "n"_a, "rate"_a,
             "xi"_a, "seed"_a = 0, "split_function"_a = "near", "transmits"_a = false,
             "Stochastic splitting with the random number xi: lights, probabilities "
             "given xi.")
        .def("splitting_probabilities", &Tree::splitting_probabilities, "p"_a, "n"_a,
             "rate"_a, "xi"_a, "split_function"_a = "near", "transmits"_a = false,
             "Probability (N) that each light is a candidate of stochastic splitting, "
             "given xi.")
        .def("refit", &Tree::refit, "flux"_a,
             "Other fluxes (N, in the order of the input) without a new 4-wide tree.")
        .def_prop_ro("depth", &Tree::depth, "Levels of the 4-wide tree.")
        .def_prop_ro("node_count", &Tree::node_count, "Nodes of the 4-wide tree.")
        .def_prop_ro("order", &Tree::order, "Input index of each leaf, in tree order.")
        .def_prop_ro("nodes", &Tree::nodes, "The 4-wide nodes as bytes.")
        .def_prop_ro("node_links", &Tree::node_links,
                     "4 * parent + slot of each 4-wide node.")
        .def_prop_ro("binary_nodes", &Tree::binary_nodes, "The binary nodes as bytes.");
    nb::class_<BrightnessMap>(m, "BrightnessMap",
                              "Brightness (H, W) of an image that covers the plane; "
                              "wrap: repeat, mirror, clamp.")
        .def(
            "__init__",
            [](BrightnessMap *self, const Image &image, const std::string &wrap) {
                new (self) BrightnessMap(brightness_map(image, wrap));
            },
            "image"_a, "wrap"_a = "repeat")
        .def("mean", &mean_brightness, "corners"_a,
             "Mean over a triangle (3, 2) or convex quadrilateral (4, 2); the image is "
             "the "
             "unit square.");
    m.def("parameters", &parameters, "plugin"_a,
          "What the parameters of a plugin may be: a dictionary each.");
    m.def(
        "light_group", &light_group, "groups"_a, "name"_a, "other"_a = "",
        "Which entry of light_groups a light with two names belongs to, and the group.");
    m.def("select", &select_items, "targets"_a, "picks"_a, "offset"_a,
          "Threshold-systematic selection: chosen items, and weights max(1, tau / "
          "target).");
    m.def("learning_passes", &learning_passes, "spp"_a, "pixels"_a,
          "The passes of a rendering that learns: first sample, count and role of each.");
    m.def("resample", &resample, "importance"_a, "probability"_a, "reservoirs"_a,
          "greedy"_a = true, "seed"_a = 0,
          "Deal candidates to reservoirs: the items held, and their weights C = W / H.");
}
