// Measure the delivery of 802.11 ad hoc broadcast frames in ns-3. `channel_against_ns3.py` compiles and starts this
// program, and explains the settings.
//
// Standard input has one cell per line: `KEY=VALUE` separated by spaces. Standard output has one line of JSON per cell.

#include "ns3/core-module.h"
#include "ns3/mobility-module.h"
#include "ns3/network-module.h"
#include "ns3/propagation-module.h"
#include "ns3/wifi-module.h"

#include <cmath>
#include <cstring>
#include <iostream>
#include <map>
#include <sstream>

using namespace ns3;

namespace
{

constexpr uint16_t PROTOCOL = 0x0800; // EtherType of IPv4
constexpr uint32_t HEADERS = 28;      // bytes of IPv4 and UDP

struct Cell
{
    std::map<std::string, std::string> keys;

    double Number(const std::string& key) const
    {
        return std::stod(keys.at(key));
    }

    const std::string& Word(const std::string& key) const
    {
        return keys.at(key);
    }
};

// The head of each payload.
struct Message
{
    uint32_t sender;
    uint32_t number;
};

// A mean with its standard error.
struct Samples
{
    double count = 0;
    double sum = 0;
    double squares = 0;

    void Add(double value)
    {
        count += 1;
        sum += value;
        squares += value * value;
    }

    double Mean() const
    {
        return count > 0 ? sum / count : 0;
    }

    double Error() const
    {
        return count > 1 ? std::sqrt(std::max(0.0, squares / count - Mean() * Mean()) / (count - 1)) : 0;
    }
};

// The stations of a cell.
class Network
{
  public:
    explicit Network(const Cell& cell)
        : m_size(static_cast<uint32_t>(cell.Number("n")))
    {
        NodeContainer nodes(m_size);
        Place(nodes, cell);
        Install(nodes, cell);
        for (uint32_t station = 0; station < m_size; ++station)
        {
            m_devices.Get(station)->SetReceiveCallback(
                [this, station](Ptr<NetDevice>, Ptr<const Packet> packet, uint16_t, const Address&) {
                    Message message;
                    packet->CopyData(reinterpret_cast<uint8_t*>(&message), sizeof(message));
                    Received(station, message);
                    return true;
                });
        }
    }

    virtual ~Network() = default;

  protected:
    virtual void Received(uint32_t station, Message message) = 0;

    void Send(uint32_t station, uint32_t number, uint32_t payload)
    {
        std::vector<uint8_t> bytes(payload + HEADERS, 0);
        Message message{station, number};
        std::memcpy(bytes.data(), &message, sizeof(message));
        auto device = m_devices.Get(station);
        device->Send(Create<Packet>(bytes.data(), bytes.size()), device->GetBroadcast(), PROTOCOL);
    }

    uint32_t m_size;

  private:
    // Place the stations at `places`, which are pairs of metres: "0:0,300:0".
    void Place(const NodeContainer& nodes, const Cell& cell)
    {
        auto places = CreateObject<ListPositionAllocator>();
        std::istringstream pairs(cell.Word("places"));
        double east;
        double north;
        for (char colon, comma; pairs >> east >> colon >> north; pairs >> comma)
        {
            places->Add(Vector(east, north, 0));
        }
        MobilityHelper mobility;
        mobility.SetPositionAllocator(places);
        mobility.SetMobilityModel("ns3::ConstantPositionMobilityModel");
        mobility.Install(nodes);
    }

    void Install(const NodeContainer& nodes, const Cell& cell)
    {
        auto loss = CreateObject<LogDistancePropagationLossModel>();
        loss->SetPathLossExponent(cell.Number("exponent"));
        loss->SetReference(1.0, cell.Number("reference_db"));
        if (double deviation = cell.Number("shadowing_db"); deviation > 0)
        {
            auto normal = CreateObject<NormalRandomVariable>();
            normal->SetAttribute("Mean", DoubleValue(0));
            normal->SetAttribute("Variance", DoubleValue(deviation * deviation));
            auto shadowing = CreateObject<RandomPropagationLossModel>();
            shadowing->SetAttribute("Variable", PointerValue(normal));
            loss->SetNext(shadowing);
        }
        auto channel = CreateObject<YansWifiChannel>();
        channel->SetPropagationLossModel(loss);
        channel->SetPropagationDelayModel(CreateObject<ConstantSpeedPropagationDelayModel>());

        YansWifiPhyHelper phy;
        phy.SetChannel(channel);
        phy.SetErrorRateModel("ns3::" + cell.Word("errors") + "ErrorRateModel");
        phy.SetPreambleDetectionModel("ns3::ThresholdPreambleDetectionModel",
                                      "Threshold",
                                      DoubleValue(cell.Number("preamble_db")),
                                      "MinimumRssi",
                                      DoubleValue(cell.Number("sensitivity_dbm")));
        phy.Set("TxPowerStart", DoubleValue(cell.Number("power_dbm")));
        phy.Set("TxPowerEnd", DoubleValue(cell.Number("power_dbm")));
        phy.Set("RxNoiseFigure", DoubleValue(cell.Number("noise_figure_db")));
        phy.Set("CcaEdThreshold", DoubleValue(cell.Number("energy_dbm")));

        WifiHelper wifi;
        std::string mode;
        if (cell.Word("standard") == "b")
        {
            wifi.SetStandard(WIFI_STANDARD_80211b);
            phy.Set("ChannelSettings", StringValue("{6, 22, BAND_2_4GHZ, 0}"));
            mode = "DsssRate1Mbps";
        }
        else if (cell.Word("standard") == "g")
        {
            wifi.SetStandard(WIFI_STANDARD_80211g);
            phy.Set("ChannelSettings", StringValue("{6, 20, BAND_2_4GHZ, 0}"));
            mode = "ErpOfdmRate6Mbps";
        }
        else
        {
            wifi.SetStandard(WIFI_STANDARD_80211a);
            phy.Set("ChannelSettings", StringValue("{36, 20, BAND_5GHZ, 0}"));
            mode = "OfdmRate6Mbps";
        }
        wifi.SetRemoteStationManager("ns3::ConstantRateWifiManager",
                                     "DataMode",
                                     StringValue(mode),
                                     "ControlMode",
                                     StringValue(mode),
                                     "NonUnicastMode",
                                     StringValue(mode));
        WifiMacHelper mac;
        mac.SetType("ns3::AdhocWifiMac", "QosSupported", BooleanValue(false));
        m_devices = wifi.Install(phy, mac, nodes);
        WifiHelper::AssignStreams(m_devices, 1000);
        for (uint32_t station = 0; station < m_size; ++station)
        {
            auto queue = DynamicCast<WifiNetDevice>(m_devices.Get(station))->GetMac()->GetTxopQueue(AC_BE_NQOS);
            queue->SetMaxSize(QueueSize(PACKETS, static_cast<uint32_t>(cell.Number("queue"))));
            queue->SetAttribute("MaxDelay", TimeValue(Seconds(1000)));
        }
    }

    NetDeviceContainer m_devices;
};

// Stations that send messages at random times (Poisson). A message counts if it is due after the warm-up.
class Beacons : public Network
{
  public:
    explicit Beacons(const Cell& cell)
        : Network(cell),
          m_payload(static_cast<uint32_t>(cell.Number("payload"))),
          m_wanted(static_cast<uint32_t>(cell.Number("messages"))),
          m_warmUp(static_cast<uint32_t>(cell.Number("warm_up"))),
          m_after(static_cast<uint32_t>(cell.Number("after"))),
          m_line(cell.Word("family") == "hidden"),
          m_gap(CreateObject<ExponentialRandomVariable>())
    {
        m_gap->SetAttribute("Mean", DoubleValue(1 / cell.Number("per_second")));
        for (uint32_t station = 0; station < m_size; ++station)
        {
            Simulator::Schedule(Seconds(m_gap->GetValue()), &Beacons::Due, this, station);
        }
        m_copies.resize(m_warmUp + m_wanted);
        m_receivers.resize(m_warmUp + m_wanted);
    }

    void Run()
    {
        Simulator::Run();
        Samples delivery;
        constexpr uint32_t BATCHES = 20;
        for (uint32_t batch = 0; batch < BATCHES; ++batch)
        {
            double copies = 0;
            double receivers = 0;
            uint32_t first = m_warmUp + static_cast<uint64_t>(m_wanted) * batch / BATCHES;
            uint32_t last = m_warmUp + static_cast<uint64_t>(m_wanted) * (batch + 1) / BATCHES;
            for (uint32_t number = first; number < last; ++number)
            {
                copies += m_copies[number];
                receivers += m_receivers[number];
            }
            delivery.Add(receivers > 0 ? copies / receivers : 0);
        }
        std::cout << "{\"delivered\": " << delivery.Mean() << ", \"error\": " << delivery.Error()
                  << "}" << std::endl;
    }

  private:
    void Due(uint32_t station)
    {
        if (m_next == m_copies.size())
        {
            // The last messages that count meet the same load as the first.
            if (m_after-- == 0)
            {
                Simulator::Stop();
                return;
            }
            Send(station, m_next, m_payload);
        }
        else
        {
            m_receivers[m_next] = m_line ? (station > 0) + (station + 1 < m_size) : m_size - 1;
            Send(station, m_next++, m_payload);
        }
        Simulator::Schedule(Seconds(m_gap->GetValue()), &Beacons::Due, this, station);
    }

    void Received(uint32_t station, Message message) override
    {
        uint32_t apart = station > message.sender ? station - message.sender : message.sender - station;
        if (message.number < m_copies.size() && (!m_line || apart == 1))
        {
            ++m_copies[message.number];
        }
    }

    uint32_t m_payload;
    uint32_t m_wanted;
    uint32_t m_warmUp;
    uint32_t m_after;
    bool m_line;
    Ptr<ExponentialRandomVariable> m_gap;
    uint32_t m_next = 0;
    std::vector<uint32_t> m_copies;
    std::vector<uint32_t> m_receivers;
};

// Station 0 asks, and each station that hears the question answers once within the jitter.
class Votes : public Network
{
  public:
    explicit Votes(const Cell& cell)
        : Network(cell),
          m_question(static_cast<uint32_t>(cell.Number("question"))),
          m_answer(static_cast<uint32_t>(cell.Number("payload"))),
          m_votes(static_cast<uint32_t>(cell.Number("messages"))),
          m_jitter(cell.Number("jitter_ms") / 1000),
          m_spread(CreateObject<UniformRandomVariable>())
    {
        Simulator::Schedule(Seconds(1), &Votes::Ask, this);
    }

    void Run()
    {
        Simulator::Run();
        std::cout << "{\"asked\": " << m_asked.Mean() << ", \"asked_error\": " << m_asked.Error()
                  << ", \"delivered\": " << m_delivered.Mean() << ", \"error\": " << m_delivered.Error()
                  << ", \"majority\": " << m_majority.Mean() << ", \"majority_error\": " << m_majority.Error()
                  << "}" << std::endl;
    }

  private:
    void Ask()
    {
        if (m_next > 0)
        {
            m_asked.Add(static_cast<double>(m_askedNow) / (m_size - 1));
            m_delivered.Add(static_cast<double>(m_heardNow) / (m_size - 1));
            m_majority.Add(2 * (m_heardNow + 1) > m_size);
        }
        if (m_next == m_votes)
        {
            Simulator::Stop();
            return;
        }
        m_askedNow = m_heardNow = 0;
        Send(0, ++m_next, m_question);
        Simulator::Schedule(Seconds(1), &Votes::Ask, this);
    }

    void Received(uint32_t station, Message message) override
    {
        if (message.sender == 0)
        {
            ++m_askedNow;
            Simulator::Schedule(Seconds(m_spread->GetValue(0, m_jitter)),
                                &Votes::Send,
                                this,
                                station,
                                message.number,
                                m_answer);
        }
        else if (station == 0)
        {
            ++m_heardNow;
        }
    }

    uint32_t m_question;
    uint32_t m_answer;
    uint32_t m_votes;
    double m_jitter;
    Ptr<UniformRandomVariable> m_spread;
    uint32_t m_next = 0;
    uint32_t m_askedNow = 0;
    uint32_t m_heardNow = 0;
    Samples m_asked;
    Samples m_delivered;
    Samples m_majority;
};

} // namespace

int
main()
{
    for (std::string line; std::getline(std::cin, line);)
    {
        Cell cell;
        std::istringstream words(line);
        for (std::string word; words >> word;)
        {
            auto equals = word.find('=');
            cell.keys[word.substr(0, equals)] = word.substr(equals + 1);
        }
        RngSeedManager::SetSeed(static_cast<uint32_t>(cell.Number("seed")));
        if (cell.Word("family") == "votes")
        {
            Votes(cell).Run();
        }
        else
        {
            Beacons(cell).Run();
        }
        Simulator::Destroy();
    }
}
