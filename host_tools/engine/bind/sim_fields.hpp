// Reading a description of a scene out of Python dicts, and writing it back. Each struct has one function
//
//     template <typename F> void fields(F &f, Struct &s) { f("key", s.key, least, most); ... }
//
// in pipefish::sim (a header bind/sim_*.hpp); Reader and Writer are its F. Kinds of fields: numbers with a range,
// arrays of them, booleans, enums (specialise Names), lists of structs, structs.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>

#include <array>
#include <cmath>
#include <string>
#include <string_view>
#include <type_traits>
#include <vector>

namespace pipefish::sim
{

namespace nb = nanobind;

constexpr double kTurn = 2 * M_PI;
constexpr double kMaxSeed = 9007199254740992.0; // 2^53: JSON numbers are exact to there

// The names of an enum's values, in their order: `static constexpr std::array<const char *, n> values`.
template <typename E> struct Names;

// Reads one dict into a struct; a key that nobody asked for is an error that lists those allowed.
class Reader
{
public:
    static constexpr bool reads = true;

    Reader(nb::handle source, std::string path) : path_(std::move(path))
    {
        if (!nb::isinstance<nb::dict>(source))
            fail(path_.substr(0, path_.find_last_not_of('.') + 1), "must be an object {...}");
        source_ = nb::borrow<nb::dict>(source);
    }

    template <typename T> void operator()(const char *name, T &value, double least, double most)
    {
        const nb::handle item = take(name);
        if (item.is_valid())
            number(path_ + name, item, value, least, most);
    }

    template <typename T, size_t N>
    void operator()(const char *name, std::array<T, N> &values, double least, double most)
    {
        const nb::handle item = take(name);
        if (!item.is_valid())
            return;
        if (!nb::isinstance<nb::list>(item) || nb::len(item) != N)
            fail(path_ + name, "must be a list of " + std::to_string(N) + " numbers");
        for (size_t i = 0; i < N; i++)
            number(path_ + name + "[" + std::to_string(i) + "]", nb::handle(item[i]), values[i], least, most);
    }

    void operator()(const char *name, std::vector<double> &list, double least, double most)
    {
        const nb::handle item = take(name);
        if (!item.is_valid())
            return;
        if (!nb::isinstance<nb::list>(item))
            fail(path_ + name, "must be a list of numbers");
        list.resize(nb::len(item));
        for (size_t i = 0; i < list.size(); i++)
            number(path_ + name + "[" + std::to_string(i) + "]", nb::handle(item[i]), list[i], least, most);
    }

    void operator()(const char *name, bool &value)
    {
        const nb::handle item = take(name);
        if (!item.is_valid())
            return;
        if (!nb::isinstance<nb::bool_>(item))
            fail(path_ + name, "must be true or false");
        value = nb::cast<bool>(item);
    }

    template <typename E>
    requires std::is_enum_v<E>
    void operator()(const char *name, E &value)
    {
        const nb::handle item = take(name);
        if (!item.is_valid())
            return;
        std::string known;
        for (size_t i = 0; i < Names<E>::values.size(); i++) {
            if (nb::isinstance<nb::str>(item) && nb::cast<std::string>(item) == Names<E>::values[i]) {
                value = static_cast<E>(i);
                return;
            }
            known += (i > 0 ? ", " : "") + std::string(Names<E>::values[i]);
        }
        fail(path_ + name, "must be one of " + known);
    }

    template <typename T> void operator()(const char *name, std::vector<T> &list)
    {
        const nb::handle item = take(name);
        if (!item.is_valid())
            return;
        if (!nb::isinstance<nb::list>(item))
            fail(path_ + name, "must be a list");
        list.clear();
        for (nb::handle entry : nb::borrow<nb::list>(item)) {
            Reader reader(entry, path_ + name + "[" + std::to_string(list.size()) + "].");
            fields(reader, list.emplace_back());
            reader.finish();
        }
    }

    template <typename T>
    requires std::is_class_v<T>
    void operator()(const char *name, T &part)
    {
        const nb::handle item = take(name);
        if (!item.is_valid())
            return;
        Reader reader(item, path_ + name + ".");
        fields(reader, part);
        reader.finish();
    }

    void finish() const
    {
        for (auto [key, value] : source_) {
            const std::string name = nb::cast<std::string>(nb::str(key));
            if (known_.find(" " + name + ",") == std::string::npos)
                fail(path_ + name, "unknown; known are" + known_.substr(0, known_.size() - 1));
        }
    }

    [[noreturn]] static void fail(const std::string &where, const std::string &what)
    {
        throw nb::value_error((where + ": " + what).c_str());
    }

private:
    nb::dict source_;
    std::string path_, known_;

    nb::handle take(const char *name)
    {
        known_ += std::string(" ") + name + ",";
        return source_.contains(name) ? nb::handle(PyDict_GetItemString(source_.ptr(), name)) : nb::handle();
    }

    template <typename T>
    static void number(const std::string &where, nb::handle item, T &value, double least, double most)
    {
        double number = 0;
        if (nb::isinstance<nb::bool_>(item) || !nb::try_cast<double>(item, number))
            fail(where, "must be a number");
        if (std::is_integral_v<T> && number != std::floor(number))
            fail(where, "must be a whole number");
        if (!(number >= least && number <= most))
            fail(where, "must be within " + text(least) + " and " + text(most) + ", not " + text(number));
        value = static_cast<T>(number);
    }

    static std::string text(double v) { return nb::cast<std::string>(nb::str(nb::float_(v))); }
};

class Writer
{
public:
    static constexpr bool reads = false;
    nb::dict out;

    template <typename T> void operator()(const char *name, T &value, double, double) { out[name] = value; }

    template <typename T, size_t N> void operator()(const char *name, std::array<T, N> &values, double, double)
    {
        nb::list items;
        for (T value : values)
            items.append(value);
        out[name] = items;
    }

    void operator()(const char *name, std::vector<double> &list, double, double)
    {
        nb::list items;
        for (double value : list)
            items.append(value);
        out[name] = items;
    }

    void operator()(const char *name, bool &value) { out[name] = value; }

    template <typename E>
    requires std::is_enum_v<E>
    void operator()(const char *name, E &value) { out[name] = Names<E>::values[static_cast<size_t>(value)]; }

    template <typename T> void operator()(const char *name, std::vector<T> &list)
    {
        nb::list items;
        for (T &entry : list) {
            Writer writer;
            fields(writer, entry);
            items.append(writer.out);
        }
        out[name] = items;
    }

    template <typename T>
    requires std::is_class_v<T>
    void operator()(const char *name, T &part)
    {
        Writer writer;
        fields(writer, part);
        out[name] = writer.out;
    }
};

} // namespace pipefish::sim
