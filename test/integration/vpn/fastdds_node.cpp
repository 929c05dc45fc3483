// SPDX-License-Identifier: Apache-2.0
//
// A Fast DDS participant for tests of the network: publishes and hears text with a number and a
// time, on topics and with the type name of ROS 2's std_msgs/String.
//
// Arguments: `to:/topic` publishes, `from:/topic` listens; `--domain N`, `--period SECONDS`,
// `--fork N` for N processes of that kind, each with topics of its own. Its profile comes from
// FASTRTPS_DEFAULT_PROFILES_FILE. Prints a JSON object a line, as dds_node.py does, and
// {"discovered": N} whenever it knows of another number of participants.

#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <time.h>
#include <unistd.h>

#include <mutex>
#include <set>
#include <sstream>
#include <string>
#include <vector>

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/domain/DomainParticipantListener.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>

using namespace eprosima::fastdds::dds;
using eprosima::fastrtps::rtps::InstanceHandle_t;
using eprosima::fastrtps::rtps::SerializedPayload_t;

namespace {

double now()
{
  timespec at;
  clock_gettime(CLOCK_MONOTONIC, &at);
  return at.tv_sec + at.tv_nsec * 1e-9;
}

// CDR, little-endian: a length with the terminating zero, then the text.
class TextType : public TopicDataType
{
public:
  TextType()
  {
    setName("std_msgs::msg::dds_::String_");
    m_typeSize = 65536;
    m_isGetKeyDefined = false;
  }

  bool serialize(void * data, SerializedPayload_t * payload) override
  {
    const std::string & text = *static_cast<std::string *>(data);
    const uint32_t size = text.size() + 1;
    const unsigned char header[] = {0, 1, 0, 0};
    memcpy(payload->data, header, 4);
    memcpy(payload->data + 4, &size, 4);
    memcpy(payload->data + 8, text.c_str(), size);
    payload->length = 8 + size;
    payload->encapsulation = CDR_LE;
    return true;
  }

  bool deserialize(SerializedPayload_t * payload, void * data) override
  {
    if (payload->length < 9) {
      return false;
    }
    *static_cast<std::string *>(data) = reinterpret_cast<char *>(payload->data + 8);
    return true;
  }

  std::function<uint32_t()> getSerializedSizeProvider(void * data) override
  {
    return [data]() { return static_cast<std::string *>(data)->size() + 9; };
  }

  void * createData() override { return new std::string; }
  void deleteData(void * data) override { delete static_cast<std::string *>(data); }
  bool getKey(void *, InstanceHandle_t *, bool) override { return false; }
};

class Hearer : public DataReaderListener
{
public:
  explicit Hearer(std::string topic) : topic_(std::move(topic)) {}

  void on_data_available(DataReader * reader) override
  {
    std::string text;
    SampleInfo info;
    while (reader->take_next_sample(&text, &info) == ReturnCode_t::RETCODE_OK) {
      const double arrival = now();
      long number;
      double sent;
      if (info.valid_data && sscanf(text.c_str(), "%ld %lf", &number, &sent) == 2) {
        printf("{\"topic\": \"%s\", \"number\": %ld, \"arrival\": %.9f, \"latency\": %.9f}\n",
          topic_.c_str(), number, arrival, arrival - sent);
      }
    }
  }

private:
  std::string topic_;
};

class Others : public DomainParticipantListener
{
public:
  void on_participant_discovery(
    DomainParticipant *, eprosima::fastrtps::rtps::ParticipantDiscoveryInfo && info) override
  {
    using Info = eprosima::fastrtps::rtps::ParticipantDiscoveryInfo;
    std::lock_guard<std::mutex> lock(mutex_);
    std::ostringstream id;
    id << info.info.m_guid;
    const size_t before = known_.size();
    if (info.status == Info::REMOVED_PARTICIPANT || info.status == Info::DROPPED_PARTICIPANT) {
      known_.erase(id.str());
    } else {
      known_.insert(id.str());
    }
    if (known_.size() != before) {
      printf("{\"discovered\": %zu}\n", known_.size());
    }
  }

private:
  std::mutex mutex_;
  std::set<std::string> known_;
};

}  // namespace

int main(int argc, char ** argv)
{
  setvbuf(stdout, nullptr, _IOLBF, BUFSIZ);
  int domain = 0, copies = 1;
  double period = 0.1;
  std::vector<std::string> names;
  for (int i = 1; i < argc; ++i) {
    const std::string word = argv[i];
    if (word == "--domain" && i + 1 < argc) {
      domain = atoi(argv[++i]);
    } else if (word == "--period" && i + 1 < argc) {
      period = atof(argv[++i]);
    } else if (word == "--fork" && i + 1 < argc) {
      copies = atoi(argv[++i]);
    } else {
      names.push_back(word);
    }
  }
  sigset_t ends;
  sigemptyset(&ends);
  sigaddset(&ends, SIGINT);
  sigaddset(&ends, SIGTERM);
  sigprocmask(SIG_BLOCK, &ends, nullptr);
  std::string suffix;
  for (int copy = 1; copy < copies; ++copy) {
    if (fork() == 0) {
      // not to outlive the one that would end it
      prctl(PR_SET_PDEATHSIG, SIGKILL);
      suffix = "_" + std::to_string(copy);
      break;
    }
  }

  DomainParticipantFactory * factory = DomainParticipantFactory::get_instance();
  factory->load_profiles();
  Others others;
  DomainParticipant * participant = factory->create_participant(
    domain, factory->get_default_participant_qos(), &others, StatusMask::none());
  if (participant == nullptr) {
    fprintf(stderr, "no participant\n");
    return 1;
  }
  TypeSupport type(new TextType);
  type.register_type(participant);
  Publisher * publisher = participant->create_publisher(PUBLISHER_QOS_DEFAULT);
  Subscriber * subscriber = participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT);
  std::vector<DataWriter *> writers;
  for (const std::string & word : names) {
    const bool out = word.rfind("to:", 0) == 0;
    const std::string name = word.substr(out ? 3 : 5) + suffix;
    Topic * topic = participant->create_topic("rt" + name, type.get_type_name(),
      TOPIC_QOS_DEFAULT);
    if (out) {
      writers.push_back(publisher->create_datawriter(topic, DATAWRITER_QOS_DEFAULT));
    } else {
      DataReaderQos qos = DATAREADER_QOS_DEFAULT;
      qos.reliability().kind = RELIABLE_RELIABILITY_QOS;
      subscriber->create_datareader(topic, qos, new Hearer(name));
    }
  }
  printf("{\"ready\": true}\n");
  timespec pause;
  pause.tv_sec = static_cast<time_t>(period);
  pause.tv_nsec = static_cast<long>((period - pause.tv_sec) * 1e9);
  for (long number = 0; sigtimedwait(&ends, nullptr, &pause) < 0; ++number) {
    for (DataWriter * writer : writers) {
      char text[64];
      snprintf(text, sizeof text, "%ld %.9f", number, now());
      std::string sample = text;
      writer->write(&sample);
    }
  }
  if (suffix.empty()) {
    // the copies are of the same process group
    signal(SIGTERM, SIG_IGN);
    if (copies > 1) {
      kill(0, SIGTERM);
    }
  }
  participant->delete_contained_entities();
  factory->delete_participant(participant);
  return 0;
}
